# `make demo` and `make test` work from a fresh clone: the first call makes .venv and installs into
# it, later calls find the stamp and go straight on. PYTHON chooses the interpreter (3.11 or newer).
PYTHON ?= python3
# Processes that share the tests; each computes with one thread, for torch's threads wait by spinning
# and made some tests ten times as slow beside another process, and takes up to 3 GB. Compiled modules
# are kept even where the environment says otherwise: else each process compiles the tests for 24 s.
WORKERS ?= 2
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint types clean blender-extension

demo: $(STAMP)
	$(BIN)/python -m warpir.insert --demo --out out/demo --overwrite

test: $(STAMP)
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -m "not slow" -n $(WORKERS) --dist loadfile $(PYTEST_ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# On the installed wheel and from another folder: inside the checkout mypy mixes the sources of
# warpir/ with the mapped packages and checks only a part of them.
types: $(STAMP)
	.ci/check-wheel types

# One zip, without Blender; `blender --command extension build` in that folder makes its like.
DIST ?= dist
blender-extension:
	mkdir -p $(DIST)
	cd integrations/blender && $(PYTHON) -m zipfile -c $(abspath $(DIST))/warpir_blender.zip \
		blender_manifest.toml *.py

# Of the libraries' 19,000 modules Python compiles those that are used, when they are imported.
$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) build dist out *.egg-info
