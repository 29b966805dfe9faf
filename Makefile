# make serve | test | demo | lint | bench. Set-up needs Python 3.11 or later with venv and pip, nothing else.
PYTHON ?= python3
PORT ?= 8080
VENV := .venv
BIN := $(VENV)/bin
# Byte code is made of what is imported, not of all that is installed: half of the time of an installation.
INSTALL := $(BIN)/python -m pip --disable-pip-version-check install --quiet --no-compile -c constraints.txt
LOCKS := pyproject.toml constraints.txt
EXAMPLE := docs/examples/hippocampus_three_slices.nii.gz

.DEFAULT_GOAL := help
.PHONY: help setup serve test lint format page demo pacs bench lock wheel clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "MorphoFlow needs Python 3.11 or later; name one with PYTHON=")'
	$(PYTHON) -m venv $(VENV)

# A stamp for each level of set-up: what serves, and all that develops and tests.
$(VENV)/.service: $(BIN)/python $(LOCKS)
	$(INSTALL) -e .
	@touch $@

$(VENV)/.demo: $(BIN)/python $(LOCKS)
	$(INSTALL) -e '.[demo]'
	@touch $@ $(VENV)/.service

$(VENV)/.development: $(BIN)/python $(LOCKS)
	$(INSTALL) -e '.[test,dev]'
	@touch $@ $(VENV)/.service $(VENV)/.demo

setup: $(VENV)/.development  ## install everything that develops and tests

serve: $(VENV)/.service  ## start the service with the models that ship, on 127.0.0.1:8080 (or PORT=)
	@PATH="$(CURDIR)/$(BIN):$$PATH" sh docs/examples/announce.sh $(PORT) $(EXAMPLE) & \
	exec $(BIN)/morphoflow serve --host 127.0.0.1 --port $(PORT)

lint: $(VENV)/.development  ## formatting, lint, types and import contracts
	$(BIN)/ruff format --check --quiet .
	$(BIN)/ruff check --quiet .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: lint  ## everything a change has to pass
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(or $(JOBS),2) --dist loadscope $(ARGS)

demo: $(VENV)/.demo  ## request, mesh, uncertainty map and a picture in one go, into build/demo
	$(BIN)/python docs/examples/demo.py build/demo

pacs: $(VENV)/.development  ## three drawn planes through Orthanc and back (Debian: orthanc-dicomweb dcmtk)
	$(BIN)/python -m benchmarks.pacs scene

bench: $(VENV)/.development  ## time and accuracy on this machine
	$(BIN)/python -m benchmarks $(ARGS)

format: $(VENV)/.development  ## put the code into shape
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

page:  ## build the page that the service serves from its sources (Node 20 or later with npm)
	rm -rf build/page/src && mkdir -p build/page && cp -R service/page/source/. build/page
	cd build/page && npm ci --no-audit --no-fund && npm run build -- --outDir $(CURDIR)/service/page/built

wheel: $(VENV)/.development  ## build/dist/*.whl
	$(BIN)/python -m build --wheel --outdir build/dist

lock:  ## renew constraints.txt from an environment of its own
	rm -rf build/lock && $(PYTHON) -m venv build/lock
	build/lock/bin/pip install --quiet 'torch==$(TORCH)' '.[test,dev]'
	head -n 2 constraints.txt > build/constraints.txt
	build/lock/bin/pip freeze --exclude morphoflow | sed 's/+cpu$$//' >> build/constraints.txt
	mv build/constraints.txt constraints.txt
lock: TORCH ?= 2.13.0

clean:  ## remove what was built
	rm -rf $(VENV) build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
