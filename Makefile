# make demo: set up what a run needs, train the built-in scene by plain 3D-GS and by the default, say where the report over both is.
# make test: set up what the tests need as well, run them.
PYTHON ?= python3
VENV ?= .venv
ifneq ($(words $(VENV)),1)
$(error VENV='$(VENV)' must be one word: make takes others for folders of their own)
endif
BIN := $(VENV)/bin
READY := $(VENV)/.ready
READY_DEV := $(VENV)/.ready-dev
PIP := $(BIN)/python -m pip install --quiet --constraint constraints.txt
# PyTorch's builds without CUDA, gigabytes smaller than those of PyPI for Linux: taken where there is no NVIDIA GPU and
# that index answers; elsewhere torch comes from the indexes that pip knows.
CPU_TORCH := https://download.pytorch.org/whl/cpu
ANSWERS := $(BIN)/python -c 'from urllib.request import urlopen; urlopen("$(CPU_TORCH)/torch/", timeout=10)'
# As many processes as cores, up to eight, with one thread each; a file's tests stay together and share what they set up.
# Compiled modules are kept, whatever the environment says: many tests start processes of their own.
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses logical --maxprocesses 8 --dist loadfile
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: demo test test-slow test-faults test-faults-short test-times site lint wheel clean

demo: $(READY)
	$(BIN)/gsx -m backbone=gs3d,gs3d_zoom 'eval.zoom=[1,2,4]'
	@echo "Open the report named in the last line above."

test: $(READY_DEV)
	$(PYTEST)

test-slow: $(READY_DEV)
	$(PYTEST) -m slow

# Kills, full disks and signals; docs/benchmarks/faults.md lists the counts.
test-faults: $(READY_DEV)
	rm -rf build/faults
	$(PYTEST) -m faults --dist load
	$(BIN)/python tests/faults/record.py

# Some two minutes of them, for CI.
test-faults-short: $(READY_DEV)
	GSX_FAULTS=0.02 $(PYTEST) -m faults --dist load $(addprefix tests/faults/, test_readers.py test_pages.py test_keys.py \
	  'test_calls.py::test_killed_at_every_call[reuse-0]' 'test_calls.py::test_every_call_fails_once[eval-0-0]' \
	  'test_signals.py::test_signals_at_random_moments[0]' \
	  'test_options.py::test_every_number[0]' 'test_full_disks.py::test_disks_that_are_too_small[0]' \
	  'test_together.py::test_two_at_once[resume-resume-0]')

test-times: $(READY_DEV)
	$(PYTEST) --file-times

# The documentation as a site; links that lead nowhere are errors (with --quiet they would not be counted).
site: $(READY_DEV)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

lint: $(READY_DEV) site
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# setuptools would pack whatever an earlier build has left
wheel: $(READY_DEV)
	rm -rf build/lib build/bdist.*
	$(BIN)/python -m build --wheel --no-isolation --outdir dist .

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "gsx needs Python 3.11 or newer; set PYTHON=...")'
	@echo "Setting up $(VENV), once: 1.2 GB on disk, more with CUDA."
	$(PYTHON) -m venv $(VENV)
	$(PIP) setuptools wheel
	index=; if ! command -v nvidia-smi > /dev/null && $(ANSWERS) 2> /dev/null; then index="--extra-index-url $(CPU_TORCH)"; \
	fi; $(PIP) torch $$index
	$(PIP) --no-build-isolation --editable .
	touch $@

$(READY_DEV): $(READY)
	$(PIP) --no-build-isolation --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info src/*.egg-info
