# make demo   SG* makes a scene, the arm searches it; the results are in out/demo
# make test   every check: lint, format, spelling, types, tests
# make nightly   what takes hours: DAMAGED_FILES damaged files of each kind, KILLS stops of each command,
#                EXPORTED_SCENES scenes of each generator in other simulators, MUTANTS mutants of the code
# make test-any PYTHON=...   the tests with an interpreter and its packages as they are, without what is not installed
# make docs   the documentation site: out/site/index.html
# Each makes its own environment in .venv first; the demo's has only what the demo needs.

PYTHON ?= python3
PIP := .venv/bin/python -m pip --disable-pip-version-check --quiet install --no-compile

.PHONY: demo docs nightly nightly-exports nightly-mutants nightly-tests test test-any

demo: .venv/demo
	rm -rf out/demo
	.venv/bin/drake-clutter demo --seed 0 --out out/demo

test: .venv/all
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/codespell
	.venv/bin/mypy
	OMP_NUM_THREADS=1 .venv/bin/pytest --numprocesses 2 --dist loadfile

nightly: export DAMAGED_FILES ?= 2000
nightly: export KILLS ?= 20
nightly: export EXPORTED_SCENES ?= 100
nightly: export MUTANTS ?= 500
nightly: export OMP_NUM_THREADS = 1
nightly: .venv/all
	$(MAKE) --keep-going nightly-tests nightly-exports nightly-mutants

nightly-tests:
	.venv/bin/pytest --numprocesses 2 tests/test_damaged_files.py tests/test_kills.py

nightly-exports:
	.venv/bin/python benchmarks/exported_stability.py out/nightly/exports --count $(EXPORTED_SCENES) --workers 2

nightly-mutants:
	.venv/bin/python benchmarks/mutation_testing.py cover --out out/nightly/coverage --workers 2
	.venv/bin/python benchmarks/mutation_testing.py run --coverage out/nightly/coverage \
	    --out out/nightly/mutants_$(MUTANTS).json --count $(MUTANTS) --workers 2

test-any:
	OMP_NUM_THREADS=1 PYTHONPATH=$(CURDIR) $(PYTHON) -m pytest -q -rs --ignore tests/test_install.py

docs: .venv/all
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet --strict

.venv/empty: requirements.lock
	$(PYTHON) -m venv --clear .venv
	touch $@

.venv/demo: .venv/empty pyproject.toml
	$(PIP) --constraint requirements.lock hatchling
	$(PIP) --constraint requirements.lock --no-build-isolation --editable ".[learned]"
	touch $@

.venv/all: .venv/empty pyproject.toml
	$(PIP) --requirement requirements.lock
	$(PIP) --no-deps --no-build-isolation --editable .
	touch .venv/demo $@
