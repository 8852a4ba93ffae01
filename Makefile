PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
CORE := $(VENV)-core
NOTEBOOKS ?= executed
export PYTHONSAFEPATH := 1
export OMP_NUM_THREADS := 1

.PHONY: help demo test lint types units notebooks core docs mutants clean

help:  ## Show the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

demo: $(INSTALLED)  ## Train VAE-DMP, calibrate, forecast, print the table and draw the bands
	$(BIN)/python -m zoo.demo

test: lint types units notebooks core  ## Everything that must hold, with its own set-up

lint: $(INSTALLED)  ## Style
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED)  ## Strict types
	$(BIN)/mypy

units: $(INSTALLED)  ## Tests
	$(BIN)/python -m pytest -n 2 --dist worksteal -q --durations 10

notebooks: $(INSTALLED)  ## Execute the notebooks
	$(BIN)/python tests/notebooks.py

core: $(CORE)/.installed  ## Smoke test of the wheel in an environment without extras
	cd $(CORE) && bin/python ../tests/smoke.py

docs: $(VENV)/.docs  ## Build the site into site/ (NOTEBOOKS=source: without executing them)
	$(BIN)/python docs/pages.py --notebooks $(NOTEBOOKS)
	$(BIN)/zensical build --strict --clean

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

$(VENV)/.docs: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	touch $@

$(CORE)/.installed: $(INSTALLED) $(shell git ls-files zoo guides datasets results 2>/dev/null)
	rm -rf $(CORE) && $(PYTHON) -m venv $(CORE)
	$(BIN)/python -m build --wheel --outdir $(CORE)/dist . > $(CORE)/build.log
	$(CORE)/bin/python -m pip install --quiet --constraint constraints.txt $(CORE)/dist/*.whl
	touch $@

mutants: $(INSTALLED)  ## Break the code on purpose, one line at a time, and count what the tests notice
	$(BIN)/python tests/mutants.py

clean:  ## Remove environments and caches
	rm -rf $(VENV) $(CORE) build dist site docs/models docs/results docs/notebooks *.egg-info .mypy_cache .pytest_cache .ruff_cache
