# Each target works as the first command in a fresh clone: Python 3.10 or newer and make are all it needs.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
# Python compiles a module, ours too, when it is first imported, and keeps the result: a tenth of what is installed ever is.
PIP    := --quiet --no-compile
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-thorough test-training test-blender check bench mutants alarms faults fuzz kills gpu offline portability lowest judge-wheel clean

demo: $(VENV)/.base
	$(BIN)/stss demo demo --overwrite

# For every commit. What takes long and whose parts other tests hold is left to test-thorough, which runs all.
test: $(VENV)/.test
	$(BIN)/python -m pytest -n 2 --dist worksteal --no-loadscope-reorder -m "not thorough"

test-thorough: $(VENV)/.test
	$(BIN)/python -m pytest -n 2 --dist worksteal --no-loadscope-reorder

# The tests that need PyTorch, some gigabytes.
test-training: $(VENV)/.test $(VENV)/.train
	$(BIN)/python -m pytest -n 2 tests/training tests/app/lab/test_onnx_export.py tests/app/lab/test_bench.py

# The extension's zip in Blender as a Python module (Python 3.11 or 3.13; 350 MB): built, installed, its button pressed.
test-blender: $(VENV)/.test
	$(PYTHON) -m venv $(VENV)-blender
	$(VENV)-blender/bin/python -m pip install $(PIP) bpy
	STSS_BPY_PYTHON=$(VENV)-blender/bin/python $(BIN)/python -m pytest tests/app/blender/test_blender_extension.py

check: $(VENV)/.check
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	$(BIN)/clang-format --dry-run --Werror kernels/*.cl kernels/*.clh
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/ci.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.citation-file-format CITATION.cff
	$(BIN)/python tests/check_text.py
	$(BIN)/pyrefly check

bench: $(VENV)/.bench
	$(BIN)/stss bench --json bench.json

# The judge judged: planted faults that it must find, and right ports that it must let pass (hours of a core each).
mutants alarms: $(VENV)/.test
	$(BIN)/python -m tests.meta.$(if $(filter mutants,$@),run_mutants,run_false_alarms)

faults: $(VENV)/.test
	$(BIN)/python -m tests.meta.run_reference_faults

# Damaged files of every kind, a hundred times as many (some minutes).
fuzz: $(VENV)/.test
	$(BIN)/python -m pytest -n 2 --hypothesis-profile=fuzz tests/hostile/test_damaged.py

kills: $(VENV)/.test
	$(BIN)/python -m tests.hostile.run_kills

# What there is to know of the first GPU that meets this: one folder, 25 minutes at most, no network once installed.
gpu: $(VENV)/.test
	$(BIN)/stss gpu-report --out gpu-report

# Every program of the GPU rows by the compilers of GPUs that are not here; wants clang-22, libclc-22 and intel-opencl-icd of the
# system; what is missing is skipped.
offline: $(VENV)/.test $(VENV)/.offline
	$(BIN)/python -m tests.offline

# Every OpenCL runtime that can be installed here, each with the tests of the backend.
portability: $(VENV)/.test
	$(BIN)/python tests/portability.py

# The tests with the oldest versions of everything that pyproject.toml allows, in an environment of its own.
lowest: $(VENV)/.base
	$(BIN)/python -m venv $(VENV)-lowest
	$(BIN)/python tests/lowest.py > $(VENV)-lowest/requirements.txt
	$(VENV)-lowest/bin/python -m pip install $(PIP) -r $(VENV)-lowest/requirements.txt pytest-xdist hatchling scipy jsonschema
	$(VENV)-lowest/bin/python -m pip install $(PIP) --no-deps --editable .
	$(VENV)-lowest/bin/python -m pytest -n 2 --dist worksteal --no-loadscope-reorder

# The judge of ports alone, without OpenCL and image libraries: dist/spacetime_supersampling_judge-*.whl.
judge-wheel: $(VENV)/.python
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist ./packaging/judge

# One stamp per extra or group, so that a target installs only what it needs, and only once.
$(VENV)/.python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10) and "stss needs Python 3.10 or newer; set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install $(PIP) --upgrade pip
	@touch $@

$(VENV)/.base: $(VENV)/.python pyproject.toml
	$(BIN)/python -m pip install $(PIP) --editable .
	@touch $@

$(VENV)/.test $(VENV)/.check $(VENV)/.offline: $(VENV)/.%: $(VENV)/.base
	$(BIN)/python -m pip install $(PIP) --group $*
	@touch $@

$(VENV)/.train $(VENV)/.bench: $(VENV)/.%: $(VENV)/.base
	$(BIN)/python -m pip install $(PIP) --editable '.[$*]'
	@touch $@

clean:
	rm -rf $(VENV) $(VENV)-blender $(VENV)-lowest build dist demo
