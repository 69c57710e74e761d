# No set-up is needed: `make demo` and `make test` make the virtual environment first.
#
#   make demo    dataset -> training -> scores -> runs/demo/report.html
#   make test    lint, types, all tests but trials: minutes on two cores
#   make trials  kills, clusters, containers, the wheel, the site; must pass as well before a change lands
#   make quick   lint, types, and the tests that take seconds
#   make guard   by how much this checkout's values differ from the stored ones, a minute; ACCEPT=1 stores them
#   make docs    the pages in site/; open site/index.html
#   make weights  trains the networks again, from nothing, into runs/weights/made: of motion, then `stereo`; many hours
#   make evidence    repeats all measurements, into runs/evidence and docs/results; PHOTO=cortex.jpg for the
#                   appearance, JOBS=2 studies at a time
#   make clean   removes all of the above
#
# PYTHON=python3.12 chooses the interpreter (3.11 or newer).

PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3; do \
	  $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
BIN := .venv/bin
DEMO := runs/demo
# The tests of a module share a process, and so what its fixtures make; modules start in the order of tests/conftest.py.
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadscope --no-loadscope-reorder
# Python compiles a module when it is imported; compiling all packages would double the time of installing.
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile -c constraints.txt
# uv needs a third of pip's time. It reads none of pip's settings, so the indexes are handed over; where it fails, pip installs.
INDEXES = $$($(BIN)/python -m pip config list | sed -nE "s/^.*\.((extra-)?index-url|find-links)='(.*)'/\1 \3/p" | \
	  awk '{for (i = 2; i <= NF; i++) print "--" $$1, $$i}')
INSTALL = { { $(PIP) uv && $(BIN)/uv pip install -q --python $(BIN)/python --index-strategy unsafe-best-match $(INDEXES) \
	  -c constraints.txt $(1); } 2>/dev/null || $(PIP) $(1); }
UNREACHABLE := { echo "the packages could not be installed: check the connection to an index of Python packages" >&2; exit 2; }

# Containers often set it; then each of a hundred processes would compile every package again, for seconds.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test trials quick guard docs weights evidence setup lint types slurm clean
.DELETE_ON_ERROR:

setup: .venv/developed .venv/checked

# `demo` installs what a user needs; the other targets add the developers' tools (3.6 instead of 2.3 GB).
.venv/installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed: install it, or run make PYTHON=/path/to/python" >&2; exit 2; }
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv || \
	  { echo "$(PYTHON) cannot make a virtual environment; on Debian: apt-get install python3-venv" >&2; exit 2; }
	@echo "installing into .venv (once; half a minute and the time of the download) ..."
	@$(call INSTALL,-e '.[bench]') || $(UNREACHABLE)
	@touch $@

.venv/developed: .venv/installed
	@echo "installing what tests need (once; a minute) ..."
	@$(call INSTALL,-e '.[dev]') || $(UNREACHABLE)
	@touch $@

# What packages can't bring: slim images lack libatomic1. One line says how to install it.
.venv/checked: .venv/installed
	@$(BIN)/python -c 'from synth.system import doctor; print("".join(f"{d.what}: {d.found}: {d.advice}\n" \
	  for d in doctor.renderer() if not d.good), end="")'
	@touch $@

demo: .venv/installed .venv/checked
	@mkdir -p $(DEMO)
	@echo && echo "1 of 4: renders videos of brain surfaces that are pushed and pulled, with force and motion of every pixel"
	$(BIN)/synth render demo -o $(DEMO)/data
	@echo && echo "2 of 4: checks that ground truth and pictures agree"
	$(BIN)/synth verify $(DEMO)/data
	@echo && echo "3 of 4: trains a small network to estimate force from motion, and tests it on other videos"
	$(BIN)/learn train $(DEMO)/data -o $(DEMO)/model --preset tiny --input mixed --epochs 30
	$(BIN)/learn eval $(DEMO)/model $(DEMO)/data
	@echo && echo "4 of 4: scores it on a video that it was not trained on, as on a recording with a force sensor"
	rm -rf $(DEMO)/recordings
	recording=$$($(BIN)/bench from-dataset $(DEMO)/data --unseen-by $(DEMO)/model -o $(DEMO)/recordings) && \
	  echo "membrane: stripped  # as in this job" >> $$recording/meta.yaml && \
	  $(BIN)/bench score $$recording --also "trained here=$(DEMO)/model" --rate 0 -o $(DEMO) \
	    --title "Force from video: a sequence unseen in training"
	@echo && echo "done: open $(DEMO)/report.html"

# Types are checked while tests run, and reported after them; the target fails if either does.
WITH_TYPES = @log=$$(mktemp) && { $(BIN)/mypy >$$log 2>&1 & types=$$!; $(1); tests=$$?; \
	  wait $$types; types=$$?; cat $$log; rm -f $$log; exit $$((tests || types)); }

test: setup lint
	$(call WITH_TYPES,$(PYTEST) -m "not trial")

trials: setup slurm
	$(PYTEST) -m trial

# One trial renders through a real SLURM. It is installed on CI machines only.
slurm:
	@if [ "$$CI" = true ] && ! command -v slurmctld >/dev/null && [ "$$(id -u)" = 0 ]; then \
	  (apt-get -qq update && apt-get -qq install -y slurm-wlm) >/dev/null 2>&1 || echo "no SLURM: its test is skipped"; fi

quick: setup lint
	$(call WITH_TYPES,$(PYTEST) -m "not slow and not trial")

guard: setup
	$(BIN)/python -m evidence guard $(if $(ACCEPT),--accept)

docs: setup
	$(BIN)/python docs/generate.py
	PYTHONPATH=docs $(BIN)/python -m zensical build --strict --clean

# Forces are learnt from motion recovered with the networks in the checkout: copy those made before if they are to be used.
WEIGHTS := runs/weights
FORCES := arch.levels=3 arch.dropout=0 arch.relative=true arch.confidence=true arch.membrane=true arch.output=vector loss=mse-frame \
	  batch=16 learning_rate=1.5e-3 frames=0 epoch_frames=4000 --also $(WEIGHTS)/bench
weights: setup
	$(BIN)/python -m weights make $(WEIGHTS)
	$(BIN)/synth render mission -o $(WEIGHTS)/mission sequences=200 seed=56
	$(BIN)/synth render weights/mission-bench.yaml -o $(WEIGHTS)/bench sequences=200
	$(BIN)/learn train $(WEIGHTS)/mission $(FORCES) --preset stereo epochs=60 surface_motion_mm=0.7 -o $(WEIGHTS)/made/stereo

evidence: setup
	$(BIN)/python -m evidence all runs/evidence $(if $(JOBS),--jobs $(JOBS)) $(if $(PHOTO),--photo $(PHOTO)) \
	  $(if $(MECHANICS_PYTHON),--mechanics-python $(MECHANICS_PYTHON)) $(if $(PICTURES_PYTHON),--pictures-python $(PICTURES_PYTHON))

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/mypy

clean:
	rm -rf .venv .cache runs build site *.egg-info .mypy_cache .ruff_cache .pytest_cache
