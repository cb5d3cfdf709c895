# Everything a fresh machine needs is Python 3.11+, make and pip; the rest is installed into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint suite slow peers clean help

help: ## say what there is
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: $(STAMP) ## print a part in simulation, break it, find what is missing, print only that
	$(BIN)/amrepair simulate --out out/demo

test: lint suite ## what CI runs

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

suite: $(STAMP)
	$(BIN)/python -m pytest -n auto --dist loadscope

slow: $(STAMP) ## the tests that take longer than a minute
	$(BIN)/python -m pytest -m slow

peers: $(STAMP) ## print through and beside OctoPrint, Moonraker and Printrun, each in its own environment
	$(BIN)/python tests/peers/environments.py
	$(BIN)/python -m pytest -m peers tests/peers

clean: ## remove the environment and what runs left behind
	rm -rf $(VENV) .peers out runs build dist
