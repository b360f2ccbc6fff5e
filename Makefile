# What a contributor uses daily. Needs nothing but Python 3.11 or later; everything goes into .venv.

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

VENV := .venv
BIN := $(VENV)/bin
REQUIREMENTS := pyproject.toml constraints.txt
DEMO_OUT := demo-out
PAGE := bidnerf/viewer/page
SHAPES := tests/testing/test_contract.py::TestHashGrid tests/cli/test_cli_bake.py::test_a_baked_map_needs_no_start
# A process a core, of one thread each; a file's tests share fixtures, and conftest.py puts the longest files first.
PARALLEL := -n logical --dist loadfile --no-loadscope-reorder
PYTEST = OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(BIN)/python -m pytest $(PARALLEL)

# The first interpreter that runs and is recent enough; override with `make PYTHON=...`.
PYTHON ?= $(shell for python in python3.11 python3 python3.14 python3.13 python3.12; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$python && break; done)

# Quiet, but downloads of many megabytes show that something goes on. Most modules are never imported: Python compiles those that
# are, the first time. It must be free to store them, or every process spends six seconds on compiling what it imports.
unexport PYTHONDONTWRITEBYTECODE
INSTALL = $(BIN)/python -m pip install --disable-pip-version-check --no-compile -c constraints.txt
SHOW_LONG = { grep --line-buffered -E 'Downloading .*(MB|GB)|^Installing collected' | cut -c1-100 || true; }

.PHONY: help demo test slow robustness shapes check lint format page types arrows records release-records wheels docs clean

help: ## this list
	@grep -E '^[a-z-]+:.*##' Makefile | sed -E 's/^([a-z-]+):[^#]*## /  make \1\t/' | expand -t 24

demo: $(VENV)/.installed-demo ## train a small scene, find poses in it, draw the result in demo-out/
	@$(BIN)/bidnerf demo --out $(DEMO_OUT) --overwrite
	@echo "the command is found after: . $(VENV)/bin/activate"

test: $(VENV)/.installed-dev ## tests of all parts, in minutes; ARGS="-k se3" for some
	@$(PYTEST) -m "not slow" $(ARGS)

slow: $(VENV)/.installed-dev ## the other tests: those that take seconds each, or run programs and install packages
	@$(PYTEST) -m slow $(ARGS)

# One training shows the shapes of all.
shapes: $(VENV)/.installed-dev ## a backend's contract and a map, with checks of all annotated shapes
	@BIDNERF_SHAPES=1 $(PYTEST) $(SHAPES) -k "not exposure and not resumes and not reports and not from_rgb" $(ARGS)

robustness: $(VENV)/.installed-dev ## hostile inputs, kills, full disks and crowds, counted; takes half an hour; ARGS="--only fuzz"
	@OMP_NUM_THREADS=1 $(BIN)/python tests/robustness/counts.py $(ARGS)

check: lint types arrows records ## everything that is checked without running the code

lint: $(VENV)/.installed-dev ## style, of Python and of JavaScript
	@$(BIN)/ruff format --check --quiet --output-format concise || { echo "not formatted: run 'make format'"; exit 1; }
	@$(BIN)/ruff check --quiet
	@$(BIN)/oxfmt --check $(PAGE) >/dev/null || { echo "JavaScript is not formatted: run 'make format'"; exit 1; }
	@$(BIN)/oxlint --deny-warnings --quiet $(PAGE) && echo "style: ok"

types: $(VENV)/.installed-dev ## static types
	@$(BIN)/mypy

arrows: $(VENV)/.installed-dev ## which module may import which
	@$(BIN)/lint-imports --no-logo

records: $(BIN)/pip ## whether the records that the documentation cites are older than what they measure
	@$(BIN)/python benchmarks/stale.py >/dev/null && echo "records: none is newly out of date"

release-records: $(BIN)/pip ## make the cited records anew that are out of date; may be interrupted; needs BIDNERF_DATA and BIDNERF_MAPS
	@OMP_NUM_THREADS=1 $(BIN)/python benchmarks/stale.py --make $(ARGS)
	@$(BIN)/python docs/tables.py

wheels: $(VENV)/.installed-dev ## what is distributed, of bidnerf and of every plugin, in dist/
	@rm -rf dist
	@printf '%s\n' . plugins/*/ | xargs -P 2 -n 1 $(BIN)/python -m build --no-isolation --quiet --outdir dist

format: $(VENV)/.installed-dev ## put the code into shape
	@$(BIN)/ruff check --fix --quiet || true
	@$(BIN)/ruff format
	@$(BIN)/oxfmt $(PAGE)

# The last line says which sources were bundled, so that a test without Node.js finds a bundle that is out of date.
page: ## the viewer's JavaScript as one file, by esbuild; needs Node.js, and is only needed after a change of it
	@npm install --silent --no-audit --no-fund
	@npm run --silent bundle -- --log-level=warning
	@cd $(PAGE) && $(PYTHON) -c 'import glob, hashlib; \
		sources = sorted(set(glob.glob("*.js")) - set(glob.glob("*.min.js"))); \
		content = b"".join(open(name, "rb").read() for name in sources); \
		print("// sources:", hashlib.sha256(content).hexdigest())' >>page.min.js

docs: $(VENV)/.installed-docs ## the documentation as a web site, in site/
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict && echo "open site/index.html"

clean: ## remove what these targets made
	rm -rf $(VENV) $(DEMO_OUT) node_modules site build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/pip:
	@$(or $(PYTHON),false) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo "Python 3.11 or later is needed, and $(if $(PYTHON),$(PYTHON) is not that,none was found)" >&2; exit 1; }
	@echo "creating $(VENV) with $$($(PYTHON) --version)"
	@rm -rf $(VENV) && $(PYTHON) -m venv $(VENV)
	@$(INSTALL) --quiet --upgrade pip # that of Python 3.11 takes twice as long for all the rest

# A stamp says that the environment matches the requirements; it is written last, so an interrupted install is repeated.
$(VENV)/.installed-demo: $(REQUIREMENTS) | $(BIN)/pip
	@echo "installing bidnerf and what it needs (minutes, the first time)"
	@$(INSTALL) -e '.[plots,viewer]' | $(SHOW_LONG)
	@touch $@

$(VENV)/.installed-docs: $(REQUIREMENTS) | $(BIN)/pip
	@echo "installing bidnerf and what its documentation needs (minutes, the first time)"
	@$(INSTALL) -e . --group docs | $(SHOW_LONG)
	@touch $@

$(VENV)/.installed-dev: $(REQUIREMENTS) | $(BIN)/pip
	@echo "installing bidnerf, what it needs and what its tests need (minutes, the first time)"
	@$(INSTALL) -e '.[all]' --group dev -e plugins/bidnerf-scanner-app | $(SHOW_LONG)
	@touch $@ $(VENV)/.installed-demo $(VENV)/.installed-docs
