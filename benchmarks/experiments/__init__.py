"""Experiments behind single choices and timings in the documentation.

Each is run as ``python -m benchmarks.experiments.NAME`` and prints a table in Markdown.
"""
