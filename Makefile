# make train ARGS="game=drone"   make test ARGS="-k hji"   make help

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.stamp

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

# pip leaves byte-compilation to the first import of a module (half a minute less), which must then be allowed to keep it.
unexport PYTHONDONTWRITEBYTECODE

# The stamp holds the path of the checkout and is written last. Without it, with a stamp of another checkout or without
# an interpreter (interrupted, copied, or Python was upgraded), the environment is built from nothing.
SOUND := $(shell test -x $(BIN)/python && test "$$(cat $(STAMP) 2>/dev/null)" = "$(CURDIR)" && echo yes)
ifneq ($(SOUND),yes)
.PHONY: $(STAMP)
endif

$(STAMP): pyproject.toml constraints.txt
	$(if $(SOUND),test -x $(BIN)/python || )$(PYTHON) -m venv --clear $(VENV)
	@rm -f $@
	@echo "Installing into $(VENV); this takes about a minute."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e ".[dev]"
	@echo "$(CURDIR)" > $@

.PHONY: help
help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "%-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

.PHONY: train
train: $(STAMP) ## train and evaluate; overrides in ARGS, e.g. ARGS="game=drone"
	$(BIN)/python train.py $(ARGS)

.PHONY: lint
lint: $(STAMP) ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m mypy hno train.py evaluate.py

.PHONY: test
test: lint ## lint, then the tests that are not slow; more options in ARGS
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal $(ARGS)

.PHONY: test-slow
test-slow: $(STAMP) ## the tests that take minutes, hours in all; more options in ARGS
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal -m slow $(ARGS)

.PHONY: test-faults
test-faults: $(STAMP) ## every injected fault, the long ones too; prints how many cases each test tried
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests/faults -m "slow or not slow" -rpP $(ARGS)

.PHONY: licences
licences: $(STAMP) ## the licence of every installed package, hno's dependencies and the tools'
	@$(BIN)/python benchmarks/licences.py

# The site is built from the sources' text: neither hno nor torch is installed here, which makes it a matter of seconds.
DOCS := .venv-docs
DOCS_EXTRA := import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"])

$(DOCS)/.stamp: pyproject.toml constraints.txt
	$(PYTHON) -m venv --clear $(DOCS)
	@$(DOCS)/bin/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt \
	    $$($(DOCS)/bin/python -c '$(DOCS_EXTRA)')
	@touch $@

.PHONY: docs
docs: $(DOCS)/.stamp ## build the documentation into site/; broken links are errors
	NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/mkdocs build --strict

.PHONY: clean
clean: ## remove the environments, caches and builds, but no results
	rm -rf $(VENV) $(DOCS) site build dist .mypy_cache .ruff_cache .pytest_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
