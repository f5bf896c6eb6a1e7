# Two commands do everything on a fresh clone: `make demo` and `make test`. Each sets up .venv first.
# `make test-all` adds what takes long: CUDA compilation, stability suites, the browser, the documentation, the wheel,
# long seeds. `make docs` builds the documentation in site/ and fails on dead links.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: demo test test-all lint types unit slow docs install clean

# A worker a core, each with one thread of launches and of BLAS; -P: the checkout in the working folder is not the
# installed package.
PYTEST := BEAM_WARP_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -P -m pytest -n auto --dist loadfile

$(VENV)/.dependencies: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed; set PYTHON=python3.x"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --upgrade pip "setuptools>=77" wheel
	$(PIP) install --quiet --no-build-isolation -e ".[dev,charts]"
	touch $@

# Strict editable mode links file by file, which is what lets pyright see the mapped folders; so it is redone each time.
install: $(VENV)/.dependencies
	$(PIP) install --quiet --no-deps --no-build-isolation -e . --config-settings editable_mode=strict

demo: install
	$(BIN)/beam demo --out demo

test: lint types unit

test-all: test slow

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install
	$(BIN)/pyright --pythonpath $(BIN)/python --threads

unit: install
	$(PYTEST) -m "not slow"

slow: install
	$(PYTEST) -m slow

docs: install
	$(BIN)/python -P docs/gather_pages.py
	$(BIN)/zensical build --clean --strict

clean:
	rm -rf $(VENV) build demo site .cache *.egg-info
