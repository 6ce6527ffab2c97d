# make demo    set up, then run the whole job on a clip that the package makes itself
# make test    set up, then every check: ruff, mypy, pytest

PYTHON ?= python3
SEED ?= 1
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.stamp

.PHONY: help setup demo test lint format bench fuzz docs clean

help:
	@echo "make setup   create $(VENV), install the package with its test tools, compile its kernels"
	@echo "make demo    the whole job on a small clip, into runs/demo"
	@echo "make test    lint, types and tests"
	@echo "make lint    ruff and mypy only"
	@echo "make format  rewrite the code in the house style"
	@echo "make bench   speed of the splat rasteriser on this machine"
	@echo "make fuzz    a thousand bad inputs, counts by kind into runs/fuzz.json (SEED=n for others)"
	@echo "make docs    the documentation as a site, into site/"
	@echo "make clean   remove $(VENV) and caches; runs/ stays"

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("expected Python 3.11 or newer, got " + sys.version.split()[0] + "; name another one: make setup PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet -c constraints.txt -e '.[test]'
	$(BIN)/mastd3r compile
	@touch $(STAMP)

demo: setup
	$(BIN)/mastd3r demo --out runs/demo

test: lint
	$(BIN)/pytest -n auto --dist loadfile

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: setup
	@mkdir -p runs
	$(BIN)/python benchmarks/bench_rasteriser.py --out runs/bench_rasteriser.json

fuzz: setup
	@mkdir -p runs
	PYTHONPATH=tests $(BIN)/python -m fuzz --cases 1050 --seed $(SEED) --out runs/fuzz.json

docs: setup
	$(BIN)/python -m pip install --disable-pip-version-check --quiet -e '.[docs]'
	$(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) build dist site .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src tests benchmarks docs -name __pycache__ -type d -prune -exec rm -rf {} +
