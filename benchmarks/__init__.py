"""The benchmark: what is run, how it is scored, and how it is reported.

Each module imports from those above it only:

- `cells.py`: a method on one set of data.
- `presets.py`, `cases.py`: settings; the data of a cell, and the NPE methods share.
- `methods.py`: the methods, one entry each.
- `suites.py` and `suites/`: the lists of cells.
- `store.py`, `scoring.py`, `runner.py`: a table of results, the scores of cells, and
  what runs them in parallel.
- `published.py`, `figures.py`, `pages.py`: select and compare results, and show them.
- `__main__.py`: the command.

Beside them, `coupling_speed.py` times the coupling.
"""
