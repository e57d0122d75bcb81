# Needs make, a Python of 3.11 or newer with its headers and a C++20 compiler (without one that of the
# ziglang wheel is fetched); everything else goes into .venv, at pinned versions.
#
#   make run        a team maps a random place; what `make test` needs is not installed for it
#   make test       all tests
#   make check      format, lint, strict types, the direction of imports
#   make core       builds the native core anew where a source of it has changed
#   make check-core the core's tests in a build with sanitizers and bounds checks
#   make bench      the benchmarks against their committed baselines; half an hour on a free machine
#   make docs       the documentation site, docs/_build/site/index.html, and the pictures of its gallery
#   make setup      what all of these need
#   make constraints    writes constraints.txt and the hashes anew from what .venv holds
#   make clean      removes what any of these made

VENV := .venv
BIN := $(VENV)/bin
# The build of an editable install warns of folders named like its packages: here they are them.
OWN := PYTHONWARNINGS=ignore $(BIN)/python -m pip --disable-pip-version-check --quiet
PIP := PIP_BUILD_CONSTRAINT=constraints.txt $(OWN)
# Every distribution comes with a hash that is known beforehand; what a platform needs beyond the list
# (none on Linux) is pinned by nothing and still installed by the step after it.
LISTED := install --require-hashes --no-deps --requirement
# The core is built without build isolation, by these.
BUILDING := cmake nanobind ninja scikit-build-core
CORE := $(wildcard team/core/src/* team/core/building/* team/core/CMakeLists.txt)
NEEDS_ZIG = @$(BIN)/python team/core/building/backend.py --find compiler > /dev/null || { \
  echo "No C++20 compiler here: installing that of the ziglang wheel (100 MB)"; $(PIP) $(LISTED) hashes-zig.txt; }
CANDIDATES := python3.11 python3.12 python3.13 python3.14 python3 python

# One BLAS thread per process: same bits everywhere, and robots do not take each other's cores.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
# A process of a team imports 300 modules: compiling them takes as long as importing them.
unexport PYTHONDONTWRITEBYTECODE

# All hashes of each version: of every platform's wheel and of the sources.
HASHED := $(VENV)/uv/bin/uv pip compile --quiet --universal --python-version 3.11.5 --generate-hashes \
  --no-annotate --no-header

.DEFAULT_GOAL := run
.NOTPARALLEL:
.DELETE_ON_ERROR:
.PHONY: run test check core check-core bench docs setup constraints clean

run: $(VENV)/.runtime $(VENV)/.own
	@echo "Running three robots for five minutes, at twenty times real time: half a minute with the report"
	@$(BIN)/teamslam launch waypoints --speed 20

# tests/conftest.py says which worker gets what.
test: $(VENV)/.dev $(VENV)/.core
	tests/get-chromium
	$(BIN)/pytest --numprocesses 3

check: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The libraries of the sanitizers come before Python, which does not know them; memory that Python
# keeps until it ends is no leak. CORE_TESTS adds tests of what is above the core, as tests/hostile.
check-core: $(VENV)/.dev
	$(BIN)/python team/core/building/backend.py --checked
	LD_PRELOAD="$$(c++ -print-file-name=libasan.so) $$(c++ -print-file-name=libstdc++.so)" \
	  ASAN_OPTIONS=detect_leaks=0 TEAMSLAM_CORE=checked $(BIN)/pytest tests/core $(CORE_TESTS)

bench: $(VENV)/.dev $(VENV)/.core
	$(BIN)/python -m benchmarks.every

# The pictures are made once; `make clean` lets them be made anew.
PICTURES := docs/generated
RUNS := run hidden peers
docs: $(VENV)/.dev $(VENV)/.core $(RUNS:%=$(PICTURES)/%/report.html) $(PICTURES)/without/maps.png $(PICTURES)/team.gif $(PICTURES)/fastslam.png $(PICTURES)/join_two_maps.png \
  $(PICTURES)/benchmarks.png $(PICTURES)/terminal.png
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going -b html docs docs/_build/site
	@echo "docs/_build/site/index.html"

$(PICTURES)/hidden/report.html: OPTIONS := --identities hidden
$(PICTURES)/peers/report.html: OPTIONS := --without-centre
$(PICTURES)/%/report.html: | $(VENV)/.dev
	rm -rf $(@D)
	mkdir -p $(PICTURES)
	COLUMNS=80 $(BIN)/teamslam launch waypoints --speed max $(OPTIONS) --output $(@D) > $(@D).txt

$(PICTURES)/without/maps.png: $(PICTURES)/run/report.html
	$(BIN)/teamslam rerun $(<D) --without r3 --output $(@D)

$(PICTURES)/terminal.png: docs/terminal.py $(PICTURES)/run/report.html
	$(BIN)/python $< $(PICTURES)/run.txt $@

# README shows a copy: docs/team.gif.
$(PICTURES)/team.gif: $(PICTURES)/run/report.html
	$(BIN)/teamslam view $(<D) --export-video $@

$(PICTURES)/benchmarks.png: benchmarks/chart.py $(wildcard benchmarks/*.json) | $(VENV)/.dev
	$(BIN)/python -m benchmarks.chart $(@D)

$(PICTURES)/%.png: examples/%.py | $(VENV)/.dev
	mkdir -p $(@D)
	$(BIN)/python $< $@

setup: $(VENV)/.dev $(VENV)/.core

core: $(VENV)/.core

constraints: $(VENV)/.dev
	@echo '# Made by `make constraints`: every distribution that a run, a test or a check takes.' > $@.new
	$(BIN)/pip freeze --all --exclude setuptools --exclude-editable >> $@.new
	mv $@.new $@.txt
	$(BIN)/python -m venv $(VENV)/uv
	$(VENV)/uv/bin/python -m pip install --quiet uv
	$(HASHED) --no-deps constraints.txt --output-file hashes.txt
	echo ziglang | $(HASHED) --no-deps - --output-file hashes-zig.txt
	echo $(BUILDING) pip | tr ' ' '\n' | $(HASHED) --constraint constraints.txt pyproject.toml - --output-file hashes-run.txt

clean:
	rm -rf $(VENV) build dist runs team/core/*.so docs/_build docs/generated *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find team central sim tests benchmarks docs examples -name __pycache__ -type d -prune -exec rm -rf {} +

# A Python that is too old, that is only a launcher's stub or that can not make environments is
# passed over. PYTHON=/path/to/python chooses one.
$(VENV)/.python:
	@found=; for python in $${PYTHON:-$(CANDIDATES)}; do \
	  if "$$python" -c 'import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; \
	  then found=$$python; break; fi; \
	done; \
	if [ -z "$$found" ]; then \
	  echo "teamslam needs Python 3.11 or newer with its venv module; tried: $${PYTHON:-$(CANDIDATES)}." >&2; \
	  echo "Install one (Debian and Ubuntu: apt install python3 python3-venv) or name it: make PYTHON=/path/to/python" >&2; \
	  exit 1; \
	fi; \
	echo "Setting up $(VENV) with $$("$$found" --version)"; \
	"$$found" -m venv --clear $(VENV)
	@sed -n '/^pip==/,/[^\\]$$/p' hashes-run.txt > $(VENV)/pip.txt
	@$(PIP) $(LISTED) $(VENV)/pip.txt
	@touch $@

$(VENV)/.runtime: pyproject.toml constraints.txt hashes-run.txt | $(VENV)/.python
	@echo "Installing $$(grep -c == hashes-run.txt) packages at pinned versions into $(VENV): a minute or two, once"
	@cp hashes-run.txt $(VENV)/run.txt  # without CMake (86 MB) where the machine has one
	@! $(BIN)/python team/core/building/backend.py --find cmake > /dev/null || \
	  sed '/^cmake==/,/[^\]$$/d' hashes-run.txt > $(VENV)/run.txt
	@$(PIP) $(LISTED) $(VENV)/run.txt
	$(NEEDS_ZIG)
	@echo "Compiling the core for this processor: about a minute on two cores, once"
	@$(OWN) install --constraint constraints.txt --no-build-isolation --config-settings cmake.define.TEAMSLAM_LEVELS=own --editable .
	@touch $(VENV)/.own $@

$(VENV)/.dev: pyproject.toml constraints.txt hashes.txt | $(VENV)/.python
	@echo "Installing $$(grep -c == hashes.txt) packages at pinned versions into $(VENV): a minute or two, once"
	@$(PIP) $(LISTED) hashes.txt
	$(NEEDS_ZIG)
	@echo "Compiling the core for all processors: two minutes on two cores, once"
	@$(OWN) install --constraint constraints.txt --no-build-isolation --editable '.[dev]'
	@touch $(VENV)/.runtime $(VENV)/.own $(VENV)/.core $@

# An install has built the core; it is built again once one of its sources is newer: for a run at
# the level of this processor, for everything else at all levels.
$(VENV)/.own: $(CORE) | $(VENV)/.runtime
	@$(BIN)/python team/core/building/backend.py --own
	@touch $@

$(VENV)/.core: $(CORE) | $(VENV)/.runtime
	@$(BIN)/python team/core/building/backend.py
	@touch $(VENV)/.own $@
