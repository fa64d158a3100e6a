"""The benchmark: what is run, how it is scored, and how it is reported.

In the order of the work:

- `presets.py` and `suites/`: settings, and the lists of what is run.
- `methods.py`: the methods, one entry each.
- `cells.py`: a method on one set of data, and the suites of such cells.
- `cases.py`: the data of a cell, and the NPE that methods share.
- `scoring.py`: scores of cells, and what they cost.
- `runner.py`: runs cells in parallel. `store.py` keeps what they gave.
- `published.py`: selects and compares results; `pages.py` and `figures.py` show them.
- `__main__.py`: the command.

What is measured beside it is in `experiments/`, one module for each question.
"""
