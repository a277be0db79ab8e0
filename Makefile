# make demo   SG* makes a scene, the arm searches it; the results are in out/demo
# make test   every check: lint, format, types, tests
# make test-any PYTHON=...   the tests with an interpreter and its packages as they are, without what is not installed
# make docs   the API's pages, from the docstrings, in out/api, and the picture of the closed loop's diagram
# Each makes its own environment in .venv first.

PYTHON ?= python3
PIP := .venv/bin/python -m pip --disable-pip-version-check --quiet

.PHONY: demo docs test test-any

demo: .venv/installed
	rm -rf out/demo
	.venv/bin/drake-clutter demo --seed 0 --out out/demo

test: .venv/installed
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	OMP_NUM_THREADS=1 .venv/bin/pytest --numprocesses 2 --dist loadfile

test-any:
	OMP_NUM_THREADS=1 PYTHONPATH=$(CURDIR) $(PYTHON) -m pytest -q -rs --ignore tests/test_install.py

docs: .venv/installed
	.venv/bin/pdoc -d google drake_clutter -o out/api
	.venv/bin/python -m drake_clutter.reports.diagram_drawing docs/images/closed_loop.svg

.venv/locked: requirements.lock
	$(PYTHON) -m venv --clear .venv
	$(PIP) install -r requirements.lock
	touch $@

.venv/installed: .venv/locked pyproject.toml
	$(PIP) install --no-deps --no-build-isolation --editable .
	touch $@
