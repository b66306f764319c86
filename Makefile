# Set-up, the main job and the checks. `make demo` and `make test` work on a fresh machine.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
EXTRAS := dev,formats,cluster,learn,tuning,sensitivity,peers
STAMP := $(VENV)/.installed

.PHONY: demo test lint bench reports setup clean

demo: setup
	$(BIN)/testbed run quickstart --out results/quickstart

test: setup
	$(BIN)/python -m pytest -n 2

lint: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: setup
	$(BIN)/python reports/benchmarks.py

reports: setup
	$(BIN)/python reports/make.py

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	@echo "compiling the kernels (once per installation)"
	rm -rf $(VENV)/first-run
	$(BIN)/testbed run quickstart --profile smoke --jobs 2 --no-report --out $(VENV)/first-run > /dev/null
	touch $(STAMP)

clean:
	rm -rf $(VENV) results
