# Everything a user types is here; each target wraps plain uv commands that the README shows too.
# A new machine needs Python 3.11+, git and make: uv is installed beside the checkout where it is missing.

UV_VERSION := 0.13.9
UV := $(shell command -v uv 2>/dev/null || echo .uv/bin/uv)
PYTHON := .venv/bin/python
# The locks name exact versions and hashes and no address, so any index or mirror serves them.
INSTALL = $(UV) pip install --quiet --require-hashes --python $(PYTHON)
export UV_PYTHON_DOWNLOADS := never
export UV_SYSTEM_CERTS := true
export OMP_NUM_THREADS := 1

.PHONY: help run test nightly bench lint report lock clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' Makefile | sed 's/:.*##/\t/' | expand -t 12

run: .venv/main.done  ## the main job: the whole catalogue on all engines, table and report
	$(PYTHON) -m plumbline run

test: .venv/test.done  ## lint, types and the fast tests
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy
	$(PYTHON) -m pytest -n 2 --dist loadgroup

nightly: .venv/test.done  ## the full matrix and the long tests
	$(PYTHON) -m plumbline run --nightly
	$(PYTHON) -m pytest -n 2 --dist loadgroup -m full

lint: .venv/test.done  ## style and types only
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy

.uv/bin/uv:
	python3 -m venv .uv
	.uv/bin/python -m pip install --quiet uv==$(UV_VERSION)

.venv/pyvenv.cfg: | $(if $(findstring .uv/bin/uv,$(UV)),.uv/bin/uv)
	$(UV) venv --quiet --allow-existing .venv

.venv/main.done: locks/main.lock | .venv/pyvenv.cfg
	$(INSTALL) -r locks/main.lock
	@touch $@

.venv/test.done: locks/test.lock | .venv/pyvenv.cfg
	$(INSTALL) -r locks/test.lock
	@touch $@ .venv/main.done

LOCK = $(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes \
	--no-emit-index-url --no-header --no-annotate pyproject.toml
lock: | .venv/pyvenv.cfg  ## resolve the dependencies again (needs the network)
	$(LOCK) --upgrade -o locks/main.lock
	$(LOCK) --upgrade -c locks/main.lock $(addprefix --group ,test truth browser history cluster bench) -o locks/test.lock

clean:  ## remove the environment and what runs made
	rm -rf .venv .uv reports/out
