# Everything a fresh machine needs is Python 3.11+, make and pip; the rest is installed into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
EXTRAS := $(VENV)/.extras
# What one worker compiles, the processes that tests start need not compile again.
unexport PYTHONDONTWRITEBYTECODE
# Tests wait for wires, killed processes and one another's kernels: two workers more than cores.
WORKERS := $(shell $(PYTHON) -c "import os; print(2 + (os.cpu_count() or 1))")

.PHONY: demo test lint suite slow chromium batches examples docs pictures peers clean help

help: ## say what there is
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[dev]'
	touch $@

$(EXTRAS): $(STAMP)
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[dev,docs,browser]'
	touch $@

demo: $(STAMP) ## print a part in simulation, break it, find what is missing, print only that
	$(BIN)/amrepair simulate --out out/demo

# The types are checked beside the tests: one of two cores is idle while that alone runs.
test: $(EXTRAS) ## what CI runs
	$(MAKE) --no-print-directory --jobs=2 lint suite

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

suite: $(EXTRAS)
	$(BIN)/python -m pytest --workers $(WORKERS)

slow: $(EXTRAS) ## the tests that are too dear for every run, and further draws of those that draw
	$(BIN)/python -m pytest -m slow

chromium: $(EXTRAS) ## report, live view and the fleet's page as a person sees and drives them
	$(BIN)/python -c "import sys; from tests.integration.browser import why_not; sys.exit(why_not())"
	$(BIN)/python -m pytest -m slow tests/integration/test_report_in_browser.py tests/integration/test_live_view_in_browser.py tests/integration/test_loop_view_in_browser.py tests/integration/test_fleet_printers.py

batches: $(EXTRAS) ## batches with every extra: Parquet, Ray, an S3 server; a thousand scans killed three times
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[batch,ray,store]'
	$(BIN)/python tests/peers/environments.py moto
	$(BIN)/python -m pytest tests/unit/test_batch.py
	$(BIN)/python -m pytest -m "slow or peers" tests/integration/test_batch_kills.py tests/peers/test_s3_store.py

peers: $(EXTRAS) ## print through and beside OctoPrint, Moonraker and Printrun, each in its own environment
	$(BIN)/python tests/peers/environments.py
	$(BIN)/python -m pytest -m peers tests/peers

examples: $(EXTRAS) ## run all eight examples, and hold what they print against the truth
	$(BIN)/python -m pytest -m "slow or not slow" --durations=8 tests/integration/test_examples.py

docs: $(EXTRAS) ## the documentation, into out/site; nothing is fetched
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

pictures: $(EXTRAS) ## run the examples and draw the documentation's pictures of them anew
	$(BIN)/python docs/dialogs.py
	$(BIN)/python docs/pictures.py

clean: ## remove the environment and what runs left behind
	rm -rf $(VENV) .peers out runs build dist
