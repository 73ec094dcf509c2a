# Two commands for a reader: `make demo` and `make test`. The rest is for those who build beamfit.
PYTHON ?= python3
BIN := .venv/bin
# The matrices are tiny: a second BLAS thread costs more than it brings.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test docs calibrate soak bench league lint clean
.DEFAULT_GOAL := demo

.venv/runtime: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

.venv/test: .venv/runtime
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[test]'
	touch $@

.venv/league: .venv/test
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[league]'
	touch $@

.venv/bench: .venv/league
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	touch $@

demo: .venv/runtime
	mkdir -p demo
	$(BIN)/beamfit emittance measurements/lcls_otr2.csv --lattice lattices/lcls_otr2.toml --report demo/lcls_otr2.html

test: .venv/test lint
	$(BIN)/python -m pytest --quiet --numprocesses 3 --dist loadfile

# The site, in build/site/index.html. Offline; warnings are errors; notebooks are executed, pictures made.
docs: .venv/test
	$(BIN)/python docs/pictures.py
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/site

# What `make test` tries on few simulations, on hundreds: calibration of the posteriors, errors of every scenario held
# against 500 scans each, false alarms, damaged files. An hour or more.
calibrate: .venv/test
	$(BIN)/python -m pytest --quiet -m calibrate --numprocesses 2 --dist loadfile -rP tests

# Damaged files, read or refused in one line: 10 000 of every kind, and 10 000 documents. Hours.
soak: .venv/test
	$(BIN)/python -m tests.soak 10000
	BEAMFIT_DOCUMENTS=10000 $(BIN)/python -m pytest --quiet tests/language/test_mutated_documents.py

lint: .venv/test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

# beamfit beside its peers in processor time: docs/speed.md.
bench: .venv/bench
	$(BIN)/python -m benchmarks.speed

# Families of simulated records by beamfit and every peer: docs/league*.md. Half an hour; DRAWS=200 for hours.
DRAWS ?= 30
league: .venv/league
	$(BIN)/python -m benchmarks.league --draws $(DRAWS)

clean:
	rm -rf .venv demo dist build
