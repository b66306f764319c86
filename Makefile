# Set-up, the main job and the checks. `make demo` and `make test` work on a fresh machine.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
EXTRAS := dev,formats,cluster,learn,tuning,sensitivity,peers
CORE := $(VENV)/.core
STAMP := $(VENV)/.installed
DOCS := $(VENV)/.docs
ORACLES := $(VENV)/.oracles

.PHONY: demo test slow lint bench reports docs setup clean

demo: $(CORE)
	$(BIN)/testbed run quickstart --out results/quickstart

test: setup
	$(BIN)/python -m pytest -n 2

# What takes minutes more: every page of the documentation, fresh installations, GNSS at the sizes of its acceptance.
slow: setup
	TESTBED_SLOW=1 TESTBED_GNSS=1 $(BIN)/python -m pytest -n 2 tests/cli/test_readme.py tests/test_installed.py tests/gnss

lint: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: $(ORACLES)
	$(BIN)/python reports/studies/benchmarks.py

# Tables and pages of every paper; ARGS="--resume", ARGS=--long, ARGS=imm-rstekf-2023 (python reports/make.py --help).
reports: setup
	$(BIN)/python reports/make.py $(ARGS)

# The pages are build/docs/index.html; a warning or a broken link is an error, and nothing is asked of the network.
docs: $(DOCS)
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet -b html docs build/docs
	$(BIN)/python docs/extensions/links.py build/docs
	@echo "documentation: build/docs/index.html"

setup: $(STAMP)

# What runs and compares Kalman filters; the rest (tests, torch, peers, file formats) comes with the first `make test`.
# Bytecode of modules that nobody imports is not made: more than half of it.
$(CORE): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) --no-compile -e .
	@echo "compiling the kernels (once per installation)"
	rm -rf $(VENV)/first-run
	$(BIN)/testbed run quickstart --profile smoke --jobs 2 --no-report --out $(VENV)/first-run > /dev/null
	touch $(CORE)

# torch by itself first: the pinned one is a CPU build.
$(STAMP): $(CORE)
	$(PIP) torch
	$(PIP) -e '.[$(EXTRAS)]'
	touch $(STAMP)

$(DOCS): $(STAMP)
	$(PIP) -e '.[docs]'
	touch $(DOCS)

# Filters and receivers of others that only benchmarks and reports are held against.
$(ORACLES): $(STAMP)
	$(PIP) -e '.[oracles]'
	touch $(ORACLES)

clean:
	rm -rf $(VENV) results build
