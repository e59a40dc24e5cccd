# make demo    64 robots under one batch PID: a table, and a picture in out/demo.png
# make test    every test but the minutes-long ones
# make check   linter, formatter and types: what CI runs before the tests
# make bench   benchmarks, with the baselines to beat
# make figures measure what docs/performance.md shows, and draw it (5 minutes, on a machine that does nothing else)
# make soak    the minutes-long tests
#
# Each builds .venv when it is missing or older than pyproject.toml. Another Python: make PYTHON=/path/to/python3.12

# The first Python that is new enough, looked for only when .venv is built.
PYTHON ?= $(or $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done),python3)
VENV := .venv
RUN := $(VENV)/bin/python
PIP := $(RUN) -m pip install --quiet --disable-pip-version-check
ARGS :=

.PHONY: demo test check format bench figures accuracy soak clean
.DELETE_ON_ERROR:

demo: $(VENV)/.base
	@$(RUN) -m batchpid demo $(ARGS)

test: $(VENV)/.dev
	@$(RUN) -m pytest --numprocesses auto --maxprocesses 8 --dist worksteal $(ARGS)

check: $(VENV)/.dev
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy
	$(VENV)/bin/lint-imports

format: $(VENV)/.dev
	$(RUN) -m ruff check --fix .
	$(RUN) -m ruff format .

bench: $(VENV)/.dev
	@$(RUN) -m pytest bench --timeout 1200 $(ARGS)

MEASURED := out/bench
bench_case = $(RUN) -m batchpid bench --robot $(1) --physics $(2) --json $(MEASURED)/$(1)-$(2).json $(3)

figures: $(VENV)/.dev
	$(call bench_case,panda,accurate,--peers)
	$(call bench_case,panda,fast)
	$(call bench_case,jaco2,accurate)
	$(call bench_case,jaco2,fast)
	@$(RUN) -m pytest bench/test_scaling.py bench/test_resources.py --benchmark-json $(MEASURED)/pytest.json
	@$(RUN) bench/draw.py $(MEASURED)

# The errors of the physics presets do not depend on the machine's speed: only new physics or gains change them.
accuracy: $(VENV)/.dev
	@$(RUN) bench/accuracy.py --json $(MEASURED)/accuracy.json
	@$(RUN) bench/draw.py $(MEASURED)

soak: $(VENV)/.dev
	@$(RUN) -m pytest -m slow --timeout 14400 $(ARGS)

clean:
	rm -rf $(VENV) out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks

# Stamp files: .base has what the product needs, .dev what it takes to work on it.
$(VENV)/.base: pyproject.toml | $(RUN)
	@echo "installing batchpid into $(VENV) (once)"
	@$(PIP) --editable .
	@touch $@

$(VENV)/.dev: pyproject.toml | $(RUN)
	@echo "installing batchpid and its development tools into $(VENV) (once; a minute or two)"
	@$(PIP) --editable '.[dev]'
	@touch $(VENV)/.base $@

$(RUN):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
		echo "batchpid needs Python 3.11 or newer; '$(PYTHON)' is: $$($(PYTHON) --version 2>&1)."; \
		echo "Install one and name it: make $(MAKECMDGOALS) PYTHON=/path/to/python3.11"; exit 1; } >&2
	@rm -rf $(VENV)
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
		echo "'$(PYTHON) -m venv' failed; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
