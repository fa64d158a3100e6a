# Everything runs in .venv, which the first target to need it creates.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: quickstart test test-fast test-slow faults test-latest-sbi lint types size
.PHONY: docs docs-code docs-site docs-links format clean package
.PHONY: examples example-quickstart example-tunnel example-tasks example-people

quickstart: $(VENV)/.installed
	$(BIN)/python examples/quickstart.py

# A process for each core, and a thread for each process.
test: $(VENV)/.installed
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n auto --dist worksteal

# Those of them that are quick, to run while working.
test-fast: $(VENV)/.installed
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n auto --dist worksteal \
	    -m "not medium and not slow and not docs and not gpu and not network"

test-slow: $(VENV)/.installed
	$(BIN)/python -m pytest -q -m "slow and not gpu and not network"

# Wrong functions, each of which a test has to notice.
faults: $(VENV)/.installed
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.faults

test-latest-sbi:
	PYTHON=$(PYTHON) .ci/latest-sbi

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.installed
	$(BIN)/pyright --pythonpath $(BIN)/python

# Lines, room by room, and the budgets that a test holds.
size: $(VENV)/.installed
	$(BIN)/python -m tests.test_size

docs: docs-code docs-site

# The code on the pages runs.
docs-code: $(VENV)/.docs
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -m docs -n auto --dist worksteal \
	    tests/integration/test_docs_code.py

# A warning is an error: a link or a reference that leads nowhere, a cell that fails.
# Notebooks are executed again if their cells have changed. Remove docs/_build to execute
# them with a package that has changed.
docs-site: $(VENV)/.docs
	OMP_NUM_THREADS=1 $(BIN)/sphinx-build -W --keep-going -j auto -b html \
	    docs docs/_build/html

# Asks for every address of other sites, and needs the network.
docs-links: $(VENV)/.docs
	$(BIN)/sphinx-build -b linkcheck docs docs/_build/linkcheck

# In reduced size. Each uses one core, so that `make -j 2 examples` runs two at a time.
OUT ?= results/examples
DATA ?= ../shared/data/causal_chamber
EXAMPLE := OMP_NUM_THREADS=1 $(BIN)/python examples
REDUCED := --n-calibration 10 --max-tuning-epochs 20 --num-folds 2

examples: example-tunnel example-quickstart example-tasks example-people

example-quickstart: $(VENV)/.installed
	$(EXAMPLE)/quickstart.py --num-simulations 1000 --max-num-epochs 2 \
	    $(REDUCED) --n-test 50 --out $(OUT)/quickstart

example-tunnel: $(VENV)/.installed
ifneq ($(wildcard $(DATA)),)
	$(EXAMPLE)/light_tunnel_sensors.py --root $(DATA) --num-simulations 2000 \
	    --density-estimator mdn $(REDUCED) --n-test 50 --out $(OUT)/tunnel
else
	@echo "examples/light_tunnel_sensors.py: skipped, no $(DATA)"
endif

example-tasks: $(VENV)/.installed
	$(EXAMPLE)/all_tasks.py --root $(DATA) --num-simulations 500 \
	    --max-num-epochs 2 $(REDUCED) --n-test 30 --out $(OUT)/all_tasks

example-people: $(VENV)/.installed
	$(EXAMPLE)/hemodynamics.py --rounds 2 --max-num-epochs 2 \
	    $(REDUCED) --n-test 30 --out $(OUT)/hemodynamics

package: $(VENV)/.installed
	PYTHON=$(PYTHON) OMP_NUM_THREADS=1 .ci/package

format: $(VENV)/.installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) $(VENV)-latest results docs/_build

$(VENV)/.installed: pyproject.toml constraints.txt
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $@

$(VENV)/.docs: $(VENV)/.installed
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[docs]"
	touch $@
