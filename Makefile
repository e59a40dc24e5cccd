# make demo    64 robots under one batch PID in SAPIEN and MuJoCo: both rates; a table, and a picture in out/demo.png
# make test     all tests but the slow ones, and every benchmark on a tiny workload
# make test-isa the tests with other instruction sets of NumPy, OpenBLAS and XLA (two runs)
# make check    linter, formatter, types, layers of imports and docs: what CI runs before the tests
# make docs     the API reference and the guides, as pages in out/site
# make bench    benchmarks and their baselines, on an idle machine (10 minutes); the last lines compare them
# make bench-check  ratios of speeds against their floors: 3 minutes, on an idle machine
# make figures  measure and redraw docs/performance.md, and draw the pictures of the guides (5 to 15 minutes, on an idle
#               machine; the pictures alone: python docs/pictures.py)
# make soak     the slow tests, each result as it comes (an hour)
# make wheel    dist/: the sdist, and from it the wheel, tried in a clean environment; needs network and a C++ compiler
#
# Each builds .venv if it is missing or older than pyproject.toml, and the extensions if they are older than their
# sources. Another Python: make PYTHON=/path/to/python3.12

# The first Python that is new enough; evaluated only when .venv is built.
PYTHON ?= $(or $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done),python3)
VENV := .venv
RUN := $(VENV)/bin/python
# One line for each step of the installation. The extensions are compiled by BUILD, and not a second time by pip.
STEP := $(RUN) .ci/step.py
PIP := env BATCHPID_NATIVE=0 $(RUN) -m pip install --progress-bar off --disable-pip-version-check
ARGS :=

# Sources of the native extensions. BUILD builds those that are older than their sources.
NATIVE := setup.py batchpid/native/extensions.py batchpid/sim/engine/native/__init__.py \
	$(filter-out %/codes.h %/passes.h %/structures.h,$(foreach folder,batchpid/native batchpid/sim/engine/native,$(wildcard $(folder)/*.cpp $(folder)/*.h))) \
	$(wildcard batchpid/native/*.py batchpid/law/*.py)
BUILD := $(STEP) "compiling native extensions" env -u BATCHPID_NATIVE $(RUN) -u -W ignore setup.py build_ext --inplace

# Compiled modules are kept, whatever the caller's setting: the tests start hundreds of processes that import them.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-isa check docs format bench bench-check figures soak wheel clean
.DELETE_ON_ERROR:

demo: $(VENV)/.base
	@$(RUN) examples/two_engines.py
	@$(RUN) -m batchpid demo --engine mujoco --picture out/demo.png --force $(ARGS)
	@echo "the command: . $(VENV)/bin/activate, then batchpid --help"

test: $(VENV)/.dev
	@$(RUN) -m pytest --numprocesses auto --maxprocesses 8 --dist worksteal --benchmark-disable $(ARGS)

# Features that NumPy chooses at run time and this processor has, by NumPy's own list (its names change by version).
numpy_features = $(RUN) -c "from numpy._core._multiarray_umath import __cpu_dispatch__ as d, __cpu_features__ as f; \
	print(*[name for name in d if f[name] and ($(1))])"

test-isa: $(VENV)/.dev
	@echo "without AVX-512, OpenBLAS for another maker's processor"
	@NPY_DISABLE_CPU_FEATURES="$$($(call numpy_features,'512' in name or name == 'X86_V4'))" OPENBLAS_CORETYPE=Haswell \
		XLA_FLAGS=--xla_cpu_max_isa=AVX2 $(MAKE) --no-print-directory test
	@echo "without AVX"
	@NPY_DISABLE_CPU_FEATURES="$$($(call numpy_features,True))" OPENBLAS_CORETYPE=Barcelona \
		XLA_FLAGS=--xla_cpu_max_isa=SSE4_2 $(MAKE) --no-print-directory test

check: $(VENV)/.dev
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy
	$(VENV)/bin/lint-imports 
	@$(MAKE) --no-print-directory docs

docs: $(VENV)/.dev
	NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build --strict

format: $(VENV)/.dev
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

bench: $(VENV)/.dev
	@$(RUN) -m pytest bench --timeout 1200 $(ARGS)

bench-check: $(VENV)/.dev
	@$(RUN) -m pytest bench -m check -s --timeout 1200 $(ARGS)

MEASURED := out/bench
bench_case = $(RUN) bench/measure.py $(1) --physics $(2) --json $(MEASURED)/$(1)-$(2).json \
	--ticks 60 --rounds 3 $(3)

figures: $(VENV)/.dev
	$(call bench_case,panda,accurate,--peers)
	$(call bench_case,panda,fast)
	$(call bench_case,jaco2,accurate)
	$(call bench_case,jaco2,fast)
	@$(RUN) bench/draw.py $(MEASURED)
	@$(RUN) docs/pictures.py

soak: $(VENV)/.dev
	@$(RUN) -u -m pytest -m slow -vv --durations 20 --numprocesses 2 --dist worksteal $(ARGS)

# The wheel is built from the sdist, so that a file which the sdist lacks is an error; so is a missing extension.
WHEEL := out/wheel
wheel: | $(RUN)
	@rm -rf $(WHEEL) dist
	@$(RUN) -m venv $(WHEEL)
	@$(WHEEL)/bin/pip install --quiet --disable-pip-version-check build
	@BATCHPID_REQUIRE_NATIVE=1 $(WHEEL)/bin/python -m build --outdir dist .
	@$(WHEEL)/bin/pip install --quiet --disable-pip-version-check dist/*.whl
	@cd $(WHEEL) && bin/batchpid demo --engine sapien --num-envs 2 --seconds 1.5 --force | grep "native calls into SAPIEN"
	@ls dist

clean:
	rm -rf $(VENV) out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks

# Stamp files: .base for what the product needs, .dev for what its development needs as well, .python and .tools for the
# installed packages of each.
$(VENV)/.base: $(VENV)/.python $(NATIVE)
	@$(BUILD)
	@touch $@

$(VENV)/.dev: $(VENV)/.tools $(NATIVE)
	@$(BUILD)
	@touch $@

$(VENV)/.python: pyproject.toml | $(RUN)
	@$(STEP) "installing packages into $(VENV) (once)" $(PIP) --editable .
	@touch $@

$(VENV)/.tools: pyproject.toml | $(RUN)
	@$(STEP) "installing packages and development tools into $(VENV) (once)" $(PIP) --editable '.[dev]'
	@touch $(VENV)/.python $@

$(RUN):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "batchpid needs Python 3.11 or newer; '$(PYTHON)' is: $$($(PYTHON) --version 2>&1)."; \
		echo "Install one and name it: make $(MAKECMDGOALS) PYTHON=/path/to/python3.11"; exit 1; } >&2
	@rm -rf $(VENV)
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "'$(PYTHON) -m venv' failed; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
