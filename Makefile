# Everything a user types is here; each target wraps plain uv commands that the README shows too.
# A new machine needs Python 3.11+, git and make: uv is installed beside the checkout where it is missing.

UV_VERSION := 0.13.9
UV := $(shell command -v uv 2>/dev/null || echo .uv/bin/uv)
PYTHON := .venv/bin/python
LAUNCHER := .venv/bin/plumbline
# The locks name exact versions and hashes and no address, so any index or mirror serves them.
INSTALL = $(UV) pip install --quiet --require-hashes --python $(PYTHON)
export UV_PYTHON_DOWNLOADS := never
export UV_SYSTEM_CERTS := true
export OMP_NUM_THREADS := 1
# Bytecode is compiled once and kept, whatever the machine's default: the tests start many processes.
export UV_COMPILE_BYTECODE := 1
export PYTHONDONTWRITEBYTECODE :=
MUTANTS ?= --sample 300 --seed 1 --jobs 2

.PHONY: help install run test fast-tests nightly bench benchmarks mutants importers engines models lint lock release clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' Makefile | sed 's/:.*##/\t/' | expand -t 12

install: .venv/truth.tried  ## install what runs need, then try it: one scenario on all engines
	$(PYTHON) -m plumbline run tumbling-ball --level state
	@printf '%s\n' '' 'Installed. Next:' \
		'  . .venv/bin/activate                 then `plumbline` is a command; `plumbline --help` lists what it does' \
		'  plumbline run double-tumbling-balls  another scenario, with its motion; `plumbline list scenarios` has all' \
		'  plumbline model FILE                 what importers make of your URDF or MJCF file' \
		'  make run                             the whole catalogue (6 to 19 minutes)'

run: .venv/truth.tried  ## the main job: the whole catalogue on all engines, table and report
	$(PYTHON) -m plumbline run

test: .venv/test.done reports/node_modules/.tried  ## style, types and the fast tests
	$(MAKE) --jobs 2 lint fast-tests

fast-tests: .venv/test.done
	$(PYTHON) -m pytest -n 4

lint: .venv/test.done  ## style and types only
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy

nightly: .venv/test.done  ## the full matrix with random scenarios and the servers that are built, the long tests, a search
	$(PYTHON) -m tools.engine_servers --options | xargs $(PYTHON) -m plumbline nightly
	$(PYTHON) -m pytest -n 2 -m full
	$(PYTHON) -m plumbline fuzz --minutes 10

bench: .venv/test.done  ## right-hand sides and work-precision beside the engines, as ratios within one run; the daily loop
	$(PYTHON) -m bench.summary
	$(PYTHON) -m bench.daily_loop --all --random 600 --night

benchmarks: .venv/test.done  ## published problems on every engine; writes docs/benchmarks.md
	$(PYTHON) -m bench.classics

mutants: .venv/mutation.done  ## do the tests notice mistakes? a sample; MUTANTS="--jobs 2" tries all
	$(PYTHON) -m tools.mutation reference_impl judging $(MUTANTS)

.uv/bin/uv:
	python3 -m venv .uv
	.uv/bin/python -m pip install --quiet uv==$(UV_VERSION)

.venv/pyvenv.cfg: | $(filter .uv/bin/uv,$(UV))
	$(UV) venv --quiet --allow-existing .venv

$(LAUNCHER): tools/launcher.sh Makefile | .venv/pyvenv.cfg
	@{ echo '#!/bin/sh'; echo 'made_in="$(CURDIR)"'; cat tools/launcher.sh; } > $@
	@chmod +x $@

.venv/main.done: locks/main.lock | .venv/pyvenv.cfg $(LAUNCHER)
	$(INSTALL) -r locks/main.lock
	@touch $@

# Taylor's method is wanted and not needed: trouble with its packages never stops the main job.
.venv/truth.tried: locks/truth.lock .venv/main.done
	-$(INSTALL) -r locks/truth.lock
	@touch $@

.venv/test.done: locks/test.lock | .venv/pyvenv.cfg $(LAUNCHER)
	$(INSTALL) -r locks/test.lock
	@touch $@ .venv/main.done .venv/truth.tried

.venv/mutation.done: locks/mutation.lock .venv/test.done
	$(INSTALL) -r locks/mutation.lock
	@touch $@

# The page's own checks (axe, tsc, eslint) need npm; where it is missing their tests are skipped with a reason.
reports/node_modules/.tried: reports/package-lock.json
	-cd reports && npm ci --no-audit --no-fund --loglevel=error
	@mkdir -p $(@D) && touch $@

importers: .importers/.done .importers-exudyn/.done  ## more importers for `plumbline model`: Drake, DART, PyBullet, Exudyn's

.importers/.done: locks/importers.lock | .venv/pyvenv.cfg
	$(UV) venv --quiet --allow-existing .importers
	$(UV) pip install --quiet --require-hashes --python .importers/bin/python -r locks/importers.lock
	@touch $@

# Only for Python 3.12 and older: the toolbox that Exudyn's loader needs has no wheels for later ones.
.importers-exudyn/.done: locks/exudyn-importer.lock | .venv/pyvenv.cfg
	$(UV) venv --quiet --allow-existing .importers-exudyn
	-$(UV) pip install --quiet --require-hashes --python .importers-exudyn/bin/python -r locks/exudyn-importer.lock
	@touch $@

engines: .venv/main.done  ## servers of Drake, DART, Rapier, Simbody: lists sizes and licences, builds what can be built here
	$(PYTHON) -m tools.engine_servers

# Only the robots' files are wanted: no dependency of these packages is installed, and nothing imports them.
.corpora/.done: locks/corpora.lock | .venv/pyvenv.cfg
	$(UV) venv --quiet --allow-existing .corpora
	UV_COMPILE_BYTECODE=0 $(UV) pip install --quiet --require-hashes --no-deps --python .corpora/bin/python \
		-r locks/corpora.lock
	@touch $@

models: .venv/test.done importers .corpora/.done  ## public robots through every importer; writes docs/importers.md
	$(PYTHON) -m tools.model_survey

LOCK = $(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes \
	--no-emit-index-url --no-header --no-annotate
lock: | .venv/pyvenv.cfg  ## resolve the dependencies again (needs the network)
	$(LOCK) pyproject.toml --extra all --upgrade -o locks/main.lock
	$(LOCK) pyproject.toml --extra all -c locks/main.lock --group truth -o locks/truth.lock
	$(LOCK) pyproject.toml --extra all -c locks/truth.lock \
		$(addprefix --group ,test truth browser history cluster bench) -o locks/test.lock
	$(LOCK) pyproject.toml --extra all -c locks/test.lock --group mutation -o locks/mutation.lock
	$(LOCK) --group importers -c locks/main.lock -o locks/importers.lock
	$(LOCK) --group exudyn-importer -o locks/exudyn-importer.lock
	$(LOCK) --group corpora --no-deps -o locks/corpora.lock

release: .venv/test.done  ## build and check the wheel, tag the commit, write the notes of CHANGELOG.md into dist
	UV=$(UV) $(PYTHON) -m tools.release

clean:  ## remove the environment and what runs made
	rm -rf .venv .uv .engines .importers .importers-exudyn .corpora reports/node_modules reports/out dist
