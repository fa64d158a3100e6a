"""Robust posterior estimation for misspecified simulators, on top of sbi."""

__version__ = "0.1.0"
