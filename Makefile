# Everything runs in .venv, which is made when it is missing or stale. Needs make and Python 3.11 or later.
#   make PYTHON=/path/to/python3.12 test     choose the interpreter
#   make WORKERS=8 test                      choose the number of test processes
#   make OUT=elsewhere reproduce             choose where the figures go

SHELL    := /bin/sh
VENV     := .venv
BIN      := $(VENV)/bin
OUT      ?= results
WORKERS  ?= 2
PYTHON   ?=
ARGS     ?=

# The problems are small: more BLAS threads slow them down and let the last digits vary from run to run.
export OMP_NUM_THREADS        := 1
export OPENBLAS_NUM_THREADS   := 1
export MKL_NUM_THREADS        := 1
export VECLIB_MAXIMUM_THREADS := 1
# Figures are written to files, so no display is needed.
export MPLBACKEND             := Agg
export PIP_DISABLE_PIP_VERSION_CHECK := 1

# A virtual environment copied along with its tree, or whose Python is gone, would run the wrong code: make it anew.
SOUND := $(shell grep -qsF "$(CURDIR)/$(VENV)" $(VENV)/pyvenv.cfg && $(BIN)/python -c "" 2>/dev/null && echo yes)
ifneq ($(SOUND),yes)
ANEW := anew
endif

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help reproduce gallery benchmark site test long sweep crowded mbm redundancy suite global brute passages singular frauds fuzz fresh moving touches faults browser installed check format dev build clean anew

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-10s  %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

reproduce: $(VENV)/run.stamp ## recompute the figures and tables of the papers into results/
	$(BIN)/python scripts/reproduce.py --out "$(OUT)"

gallery: $(VENV)/gallery.stamp ## plan, audit and draw the examples with real robots into results/gallery
	$(BIN)/python scripts/gallery.py --out "$(OUT)"

benchmark: $(VENV)/peers.stamp $(VENV)/test.stamp ## time model functions, builds, solves and plans, also with other packages
	$(BIN)/python scripts/benchmark.py --out "$(OUT)"

site: $(VENV)/site.stamp ## build the documentation into build/site, run the code of its pages, check every link
	rm -rf build/site
	$(BIN)/python -m sphinx -q -E -a -j $(WORKERS) --fail-on-warning --keep-going -d build/doctrees docs build/site
	$(BIN)/python -m docs.links build/site

test: $(VENV)/test.stamp ## run the fast tests (ARGS="-k momentum -x" passes options on to pytest)
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup $(ARGS)

long: $(VENV)/test.stamp ## run the slow tests: the gallery, random paths and robots, standing plans
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup -m long $(ARGS)

sweep: $(VENV)/test.stamp ## audit a thousand random problems of known solution (ARGS="--only pendulum --seed 3")
	$(BIN)/python -m tests.sweep --workers $(WORKERS) --out "$(OUT)" $(ARGS)

crowded: $(VENV)/test.stamp ## plan 300 random tasks among boxes, check for collisions with coal (ARGS="--only ur5 --count 20")
	$(BIN)/python -W ignore -m tests.sweep.crowded --out "$(OUT)/sweeps/crowded.jsonl" $(ARGS)

brute: $(VENV)/test.stamp ## compare 1000 global searches with all sequences of configurations on a fine grid (ARGS="--again": repeat old results)
	$(BIN)/python -W ignore -m tests.sweep.brute_force --out "$(OUT)/sweeps/brute_force.jsonl" $(ARGS)

global: $(VENV)/test.stamp ## compare 300 plans of search="global" with solves from 200 random starts each, and 1000 with their bounds (ARGS="--only panda")
	$(BIN)/python -W ignore -m tests.sweep.global_plans --out "$(OUT)/sweeps/global_plans.jsonl" $(ARGS)

redundancy: $(VENV)/test.stamp ## plan and check six problems of a published benchmark of redundant arms (ARGS="--only panda__1cube")
	$(BIN)/python -W ignore -m tests.sweep.redundancy --out "$(OUT)/sweeps/redundancy.jsonl" $(ARGS)

mbm: $(VENV)/test.stamp ## plan 700 problems of MotionBenchMaker, 70 also in least time (DATA=FOLDER of robot and problems; ARGS="--only cage")
	$(BIN)/python -W ignore -m tests.sweep.motion_bench_maker --data "$(DATA)" --out "$(OUT)/sweeps/motion_bench_maker.jsonl" $(ARGS)

suite: $(VENV)/peers.stamp $(VENV)/test.stamp ## solve, audit and confirm the problems of three public suites (ARGS="--only chain --again")
	$(BIN)/python -W ignore -m tests.conformance.suite --out "$(OUT)/suite" $(ARGS)
	$(BIN)/python scripts/suite.py --out "$(OUT)"

passages: $(VENV)/test.stamp ## plan 40 feasible paths of floating arms past singularities (ARGS="--only beyond": infeasible ones)
	$(BIN)/python -W ignore -m tests.sweep.passages --out "$(OUT)/sweeps/passages.jsonl" $(ARGS)

singular: $(VENV)/test.stamp ## compare plans from nearly singular configurations with damped least squares (ARGS="--only ur5")
	$(BIN)/python -W ignore -m tests.sweep.singular --out "$(OUT)/sweeps/singular.jsonl" $(ARGS)

frauds: $(VENV)/test.stamp ## falsify eight plans in 264 ways and audit them; check plans that pass by other means (ARGS="--only arm")
	$(BIN)/python -W ignore -m tests.sweep.frauds --out "$(OUT)/sweeps/frauds.jsonl" $(ARGS)

moving: $(VENV)/test.stamp ## prove clearance from 200 random obstacles that jump and spin, and compare with coal (ARGS="--only ur5 --count 20")
	$(BIN)/python -W ignore -m tests.sweep.moving_obstacles --out "$(OUT)/sweeps/moving_obstacles.jsonl" $(ARGS)

touches: $(VENV)/test.stamp ## plant 100000 touches on moving arms: none is proven clear (ARGS="--only 'seven joints'")
	$(BIN)/python -W ignore -m tests.sweep.touches --out "$(OUT)/sweeps/touches.jsonl" $(ARGS)

faults: $(VENV)/test.stamp ## kill workers, drivers and a cluster during batches of 500 plans, and fill a disk
	$(BIN)/python -W ignore -m tests.sweep.faults

fuzz: $(VENV)/test.stamp ## read 2000 damaged files of each kind: none crashes, hangs, runs code or writes elsewhere (ARGS="--only csv,urdf")
	$(BIN)/python -W ignore -m tests.sweep.fuzz $(ARGS)

fresh: $(VENV)/test.stamp ## audit plans before they are saved and again after loading in another process (ARGS="--only blend")
	$(BIN)/python -W ignore -m tests.sweep.fresh $(ARGS)

browser: $(VENV)/test.stamp ## open pages of the viewer and of the site in a real browser (ARGS=--if-there: only if one is installed)
	$(BIN)/python -W ignore -m tests.browser $(ARGS)

installed: $(VENV)/run.stamp ## install the wheel with its extras in a new environment and use it as a new user would
	$(BIN)/python -m tests.installed $(ARGS)

check: $(VENV)/check.stamp ## check style, formatting and types without changing a file
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/check.stamp ## reformat the code and apply safe corrections of its style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

dev: $(VENV)/dev.stamp ## install everything that a developer needs, and the pre-commit hooks
	$(BIN)/pre-commit install

build: $(VENV)/build.stamp ## build the source distribution and the wheel into dist/ and check their metadata
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python -m twine check --strict dist/*

clean: ## remove .venv, caches and build output (never results/)
	rm -rf $(VENV) dist build .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/made.stamp: $(ANEW)
	@python="$(PYTHON)"; \
	suitable='import sys; sys.exit(sys.version_info < (3, 11))'; \
	if [ -n "$$python" ]; then \
	  "$$python" -c "$$suitable" 2>/dev/null || { \
	    echo "make: PYTHON=$$python is not a Python 3.11 or later that runs." >&2; exit 1; }; \
	else \
	  for candidate in python3 python3.13 python3.12 python3.11 python; do \
	    if "$$candidate" -c "$$suitable" 2>/dev/null; then python="$$candidate"; break; fi; \
	  done; \
	  if [ -z "$$python" ]; then \
	    echo "make: no Python 3.11 or later on the PATH; install one, or name it: make PYTHON=/path/to/python3.12 ..." >&2; \
	    exit 1; \
	  fi; \
	fi; \
	echo "making $(VENV) with $$("$$python" --version)"; \
	"$$python" -m venv --clear $(VENV) || { \
	  echo "make: $$python cannot make a virtual environment (on Debian and Ubuntu: apt install python3-venv)." >&2; \
	  rm -rf $(VENV); exit 1; }
	@touch $@

$(VENV)/run.stamp: $(VENV)/made.stamp pyproject.toml
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(VENV)/%.stamp: $(VENV)/made.stamp pyproject.toml
	$(BIN)/python -m pip install --quiet --editable ".[$*]"
	@touch $@
