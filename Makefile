# Every target sets up what it needs, once, in $(VENV). Needs Python 3.11 or newer and make, nothing else.

VENV    ?= .venv
WORKERS ?= 2
# The first interpreter found that is new enough; say `make PYTHON=/path/to/python3.11` to choose another.
PYTHON  ?= $(shell for name in python3.11 python3.12 python3.13 python3 python; do \
	"$$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo "$$name" && break; done)
BIN     = $(VENV)/bin
# --no-compile: Python compiles the few modules that are used when it first meets them, which halves the set-up.
PIP     = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
PYTEST  = $(BIN)/python -m pytest
# Tests of one file share what they fit and compile: a worker takes whole files.
BY_FILE = -n $(WORKERS) --dist loadfile
CORE    = $(VENV)/core.stamp
DEV     = $(VENV)/dev.stamp
ALL     = $(VENV)/all.stamp
SITE    = $(VENV)/site.stamp

# Two BLAS threads that fight over small blocks make a solve fifty times slower.
export OPENBLAS_NUM_THREADS = 1
# Empty: compiled modules are kept even where a container image says not to. Without them every program compiles what it
# imports anew, which takes 10 instead of 4 processor seconds before `rfdropo check` begins.
export PYTHONDONTWRITEBYTECODE =

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow test-studies test-typed test-portable test-compiler test-all part mutants matrix matrix-drawn notebook-drawn lint format bench validate notebooks notebook-outputs gallery reference site demo-data clean

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1|\2/p' Makefile | awk -F'|' '{ printf "  %-20s%s\n", $$1, $$2 }'

demo: $(CORE) ## calibrate the bundled example and write its report (minutes)
	$(BIN)/rfdropo calibrate experiments/demo.toml --out runs/demo --overwrite
	@echo "The report: runs/demo/report.html"

test: $(DEV) ## the tests that are not slow
	$(PYTEST) $(BY_FILE) -m "not slow and not notebook" --ignore=tests/studies
	$(BIN)/python tools/yardstick.py

test-slow: $(DEV) ## the slow tests, without those of studies, matrix and notebooks
	$(PYTEST) $(BY_FILE) -m "slow and not notebook" --ignore=tests/studies --ignore=tests/verbs/test_matrix.py --ignore=tests/verbs/test_commands_matrix.py

# The other tests leave this out: it doubles what the numerical rooms cost.
test-typed: $(DEV) ## the tests of the numerical rooms with the shapes of all arrays checked at run time
	$(PYTEST) $(BY_FILE) --typed -m "not slow and not notebook" tests/fem tests/bayes tests/inference tests/discrepancy tests/simulators

test-studies: $(ALL) ## the tests of what is run for papers, in studies/
	$(PYTEST) $(BY_FILE) tests/studies

# The rooms that compute. `make test-portable ROOMS="policies discrepancy"` runs some of them: those that learn, sample and
# search are where a test that rests on one processor shows, because a last bit becomes another curve there.
test-portable: $(DEV) ## the numerical tests with other instruction sets: what rests on one processor fails
	$(BIN)/python tools/portable.py $(ROOMS) -- -n $(WORKERS)

test-all: test test-slow test-studies test-typed test-portable test-compiler matrix notebooks ## every test; each part can be run alone (hours)

# `make part PART=test-slow`
part: $(DEV) ## a part of test-all, with a line of what it found in reports/checks/parts.csv
	$(BIN)/python tools/parts.py $(PART)

mutants: $(DEV) ## faults that the tests must see, one at a time (tools/mutants.py; half an hour)
	$(BIN)/python tools/mutants.py

matrix: $(DEV) ## every method and every command, on the demo, an own robot and a mesh body (minutes)
	$(PYTEST) -n $(WORKERS) --dist loadgroup tests/verbs/test_matrix.py tests/verbs/test_commands_matrix.py

COMMIT = $(shell git rev-parse HEAD 2>/dev/null || echo none)

matrix-drawn: $(DEV) ## a tenth of the matrix, drawn by the commit
	$(PYTEST) -n $(WORKERS) --dist loadgroup --drawn 10% --by $(COMMIT) tests/verbs/test_matrix.py tests/verbs/test_commands_matrix.py

notebook-drawn: $(DEV) ## one notebook, drawn by the commit
	$(PYTEST) -m notebook --drawn 1 --by $(COMMIT) tests/test_notebooks.py

test-compiler: $(DEV) ## the engine of rods, its kernels compiled by Numba's own compilers (docs/native.md)
	RFDROPO_COMPILER=numba $(PYTEST) -n $(WORKERS) tests/fem/test_native_rod.py tests/fem/test_native_session.py tests/fem/test_compilers.py

lint: $(DEV) ## ruff, its formatter, and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(DEV) ## let ruff mend what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(CORE) ## rollouts and poses per second beside other simulators, in reports/rollouts (minutes, on an idle machine)
	$(BIN)/python benchmarks/rollouts.py --push --json reports/rollouts/rollouts.json
	$(BIN)/python benchmarks/poses.py --json reports/rollouts/poses.json

validate: $(CORE) ## references and other simulators with ours beside them, in reports/validation (minutes)
	$(BIN)/python benchmarks/validate.py

notebooks: $(DEV) ## run every notebook from top to bottom
	$(PYTEST) -n $(WORKERS) -m notebook

site: $(SITE) ## the documentation as pages, in site/; needs no network
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --clean

gallery: $(DEV) ## run the examples, and draw docs/gallery.md of them (minutes)
	$(BIN)/python tools/gallery.py

reference: $(DEV) ## write docs/reference from the code, and docs/measured.md from the ledgers
	$(BIN)/python tools/reference.py
	$(BIN)/python tools/measured.py

notebook-outputs: $(DEV) ## run every notebook and keep its outputs in it
	cd notebooks && PYTHONWARNINGS='ignore:IProgress not found' ../$(BIN)/jupyter-execute --inplace --timeout=1800 *.ipynb

demo-data: $(CORE) ## make the recordings of the bundled example again
	$(BIN)/rfdropo simulate experiments/demo_data.toml --out experiments/demo --overwrite

clean: ## remove the environment and what the tools cached; runs stay
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist
	find rfdropo_bayes tests -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "rfdropo_bayes needs Python 3.11 or newer; none found. Install it, or name it: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	@echo "Setting up $(VENV) with $$($(PYTHON) --version) (once; a few minutes)"
	$(PYTHON) -m venv $(VENV)

$(CORE): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable .
	@touch $@

$(DEV): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable '.[dev]'
	@touch $(CORE) $@

# Apart from what `make test` needs.
$(ALL): pyproject.toml constraints.txt studies/requirements.txt | $(BIN)/python
	$(PIP) --editable '.[dev]' --requirement studies/requirements.txt
	@touch $(CORE) $(DEV) $@

$(SITE): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable '.[dev,site]'
	@touch $(CORE) $@
