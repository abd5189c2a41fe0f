# `make demo` and `make test` need python3 and make, nothing else. With other versions:
# `make test PYTHON=python3.14 VERSIONS=newest VENV=.venv-newest` (see constraints/).
PYTHON ?= python3
VERSIONS ?= cpu
VENV ?= .venv
PYTEST_ARGS ?=
CONSTRAINTS := constraints/$(VERSIONS).txt
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DEMO := .venv-demo

SAMPLE := build/sample
SYNTH := $(BIN)/stereogenbench synth $(SAMPLE)/release --size 72 --frames 81 --depth-unit-m 0.01

.PHONY: demo test test-blender lint docs bench sample descriptors clean
.DELETE_ON_ERROR:

# The sdist leaves out the sample.
shards/index.parquet:
	@echo "shards/ is missing: the sdist leaves out the sample scenes (11 MB) that tests and demo" \
		"read. Run make in a clone of the repository." >&2
	@exit 1

# The package and matplotlib are all that it needs; tests and lint need many times as much. Threads of
# torch that wait for one another beside busy workers shall not take the cores from them.
demo: shards/index.parquet $(DEMO)/.ready
	OMP_WAIT_POLICY=PASSIVE $(DEMO)/bin/python examples/train.py

$(DEMO)/.ready: pyproject.toml $(CONSTRAINTS)
	$(PYTHON) -m venv $(DEMO)
	$(DEMO)/bin/python -m pip install --quiet --disable-pip-version-check \
		--constraint $(CONSTRAINTS) --editable ".[plots]"
	touch $@

# Tests wait for a quarter of their time, so there is a process more for every two cores; each
# computes with one thread.
test: shards/index.parquet lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest $(PYTEST_ARGS) --numprocesses $$($(BIN)/python -c "import os; print(os.cpu_count() * 3 // 2)") --maxprocesses 8 --dist worksteal

# Blender's wheels are for Python 3.13, so its tests have an environment of their own.
BLENDER_PYTHON ?= python3.13
test-blender:
	$(BLENDER_PYTHON) -m venv .venv-blender
	.venv-blender/bin/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints/cpu.txt --editable ".[blender,blosc2,evaluation]" \
		beartype embreex hypothesis pytest pytest-timeout trimesh
	OMP_NUM_THREADS=1 .venv-blender/bin/python -m pytest tests/synthesis/test_blender.py

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(READY)
	$(BIN)/python docs/generated_pages.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

# Draws its scenes first (20 minutes or so, kept in build/bench), then races for some 15 minutes.
# `.venv/bin/python -m benchmarks --only all` is everything: an hour from the disk, and some six hours
# over networks. Let nothing else run.
bench: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint $(CONSTRAINTS) --editable ".[bench]"
	$(BIN)/python -m benchmarks

# The scenes in shards/: videos are not drawn to the same bytes everywhere, packing is the same.
sample: $(READY)
	rm -rf $(SAMPLE)
	$(SYNTH) --family IPD_Gaussian --seed 1
	$(SYNTH) --family Uniform --seed 2 --scenes 2
	$(SYNTH) --family Pairwise_Uniform --seed 3
	$(SYNTH) --family IPD_Gaussian --seed 4 --split eval
	$(SYNTH) --family Uniform --seed 5 --split eval
	$(SYNTH) --family IPD_Gaussian --seed 6 --split eval --subset unseen_map --map SynthYard
	$(SYNTH) --family Uniform --seed 7 --split eval --subset unseen_map --map SynthYard
	$(BIN)/stereogenbench pack $(SAMPLE)/release $(SAMPLE)/shards --shard-size 4MB
	rm -f shards/*.tar
	cp -r $(SAMPLE)/shards/* shards/
	$(BIN)/stereogenbench verify --deep shards

# croissant/, from the sample, what shards/about.json says of it, and the paper.
descriptors: $(READY)
	rm -rf croissant
	$(BIN)/stereogenbench publish croissant shards -o croissant/sample.json \
		--about shards/about.json
	$(BIN)/stereogenbench publish croissant -o croissant/release.json
	$(BIN)/stereogenbench publish croissant --template -o croissant/template.json

$(READY): pyproject.toml $(CONSTRAINTS)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint $(CONSTRAINTS) --editable ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) $(DEMO) .venv-blender demo build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
