# Every target sets up what it needs, in .venv.  With ROS 2 Jazzy sourced, the machine's client library is
# used; else the same library comes from PyPI, for Python 3.11 or 3.12.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help
.PHONY: help demo experiment test jazzy lint sanitize aarch64 bench soak figures clean

VENV := .venv
PYTHON := $(VENV)/bin/python
# Without bytecode, each of the many processes of a test compiles all that it imports.
unexport PYTHONDONTWRITEBYTECODE
MEASURED := $(wildcard $(or $(DLO_DATA),../shared/data))
LINT := test/test_lint.py test/test_architecture.py test/test_packaging.py

ifeq ($(shell test "$${ROS_DISTRO-}" = jazzy && python3 -c 'import rclpy' 2>/dev/null && echo yes),yes)
# numpy 2 cannot load message types that were built against numpy 1.
ROS := machine
CANDIDATES := python3
VENV_OPTIONS := --system-site-packages
NUMPY := 'numpy<2'
else
# Libraries of another ROS or of another environment must not mix with those of .venv.
ROS := pypi
CANDIDATES := python3.11 python3 python3.12
VENV_OPTIONS :=
EXTRA := [ros]
unexport PYTHONPATH PYTHONHOME LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
export AMENT_PREFIX_PATH := $(abspath $(VENV))
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
endif
STAMP := $(VENV)/installed-with-ros-from-$(ROS)
TESTED := $(STAMP)-and-tests
CORE := $(shell find dlo_calibration/simulation/core -name '*.?pp')

# Without a C++ compiler, Zig comes from PyPI.  It compiles for the processor at hand unless told otherwise.
ifeq ($(origin CXX)$(shell command -v c++ g++),default)
CLANG := $(shell command -v clang++)
ZIG := $(if $(CLANG),,ziglang)
export CC := $(or $(CLANG),$(abspath $(PYTHON)) -m ziglang c++ -mcpu=baseline)
export CXX := $(CC)
export LDSHARED := $(CC) -shared
export LDCXXSHARED := $(CC) -shared
endif

help:
	@cat <<-END
	  make demo    calibrate a sample session with the real node, and draw the result
	  make test    run the tests; some that take long are left to make soak
	  make experiment   repeat the paper's experiment on the samples: consistency and validity, as tables;
	               then execute plans with fitted, default and true parameters: what calibration is worth
	  make jazzy   run the tests with the libraries of Ubuntu 24.04, on which ROS 2 Jazzy is used
	  make lint    run the checks of style, types, imports and packaging alone
	  make sanitize   run the tests of the engines with a core that checks its memory and its arithmetic
	  make aarch64    compile the core for ARM, with Zig of PyPI
	  make bench   measure speed, memory, start-up and accuracy, and compare the engines: about 35 minutes
	  make soak    run long tests, draw many random examples, try hostile input and faults: an hour or more
	  make figures make all tables of benchmark/results: make bench, and then some hours
	  make clean   remove .venv and everything that was built
	END

demo: $(STAMP)
	@$(PYTHON) -m dlo_calibration.cli.demo

experiment: $(STAMP)
	@$(PYTHON) -m dlo_calibration experiment
	$(PYTHON) benchmark/worth.py

# One process more than there are cores, as some tests wait; four are enough.  Linear algebra and image
# processing shall not start threads besides, which would wait for each other.
test: export OPENBLAS_NUM_THREADS := 1
test: export OPENCV_FOR_THREADS_NUM := 1
test: $(TESTED)
	@$(with_headers)
	cores=$$(nproc)
	$(PYTHON) -m pytest --numprocesses $$((cores < 4 ? cores + 1 : 4)) --dist worksteal --durations 10 $(ARGUMENTS)

# `make test` has the newest libraries of PyPI; some code that they run, these older ones refuse.
jazzy:
	@export UV_CONSTRAINT=$(abspath test/ubuntu-24.04.txt)
	export PIP_CONSTRAINT=$$UV_CONSTRAINT
	$(MAKE) --no-print-directory test VENV=build/jazzy

lint: $(TESTED)
	@$(PYTHON) -m pytest -m '' $(LINT)

# Address and undefined behaviour; the library that checks must be there before Python begins.
sanitize: $(TESTED)
	@$(with_headers)
	export DLO_CXXFLAGS='-fsanitize=address,undefined -fno-sanitize-recover=all -O1 -g'
	$(PYTHON) setup.py --quiet build --build-base build/sanitized --build-lib build/sanitized/lib
	ln -sfn $(abspath msg_samples) build/sanitized/lib
	export LD_PRELOAD=$$(for name in asan ubsan stdc++; do
	  $(CXX) -print-file-name=lib$$name.so
	done | paste -sd:)
	export ASAN_OPTIONS=detect_leaks=0 PYTHONSAFEPATH=1 PYTHONPATH=build/sanitized/lib
	$(PYTHON) -c 'from dlo_calibration.simulation.core import _core; assert "sanitized" in _core.__file__'
	$(PYTHON) -m pytest test/simulation/test_engine_contract.py test/simulation/test_core.py \
	  test/simulation/test_scene_contact.py

# Whether the core compiles for ARM; it is neither linked nor started.
aarch64: $(TESTED)
	@$(PIP) install --quiet ziglang
	mkdir -p build/aarch64
	ln -sfn /usr/include/$$(uname -m)-linux-gnu build/aarch64/aarch64-linux-gnu  # where Debian has pyconfig.h
	headers=$$($(PYTHON) -c 'import pybind11 as p, sysconfig as s; print(p.get_include(), s.get_path("include"))')
	for source in $(filter %.cpp,$(CORE)); do
	  $(PYTHON) -m ziglang c++ -target aarch64-linux-gnu -std=c++17 -O3 -ffp-contract=off -Wall -Wextra -Werror \
	    -fPIC -Idlo_calibration/simulation/core $$(printf ' -isystem %s' $$headers build/aarch64) \
	    -c $$source -o build/aarch64/core.o
	done

bench: $(TESTED)
	@$(prepare)
	$(PYTHON) -c 'import mujoco' 2>/dev/null || extra bench
	$(PYTHON) -m pytest benchmark
	$(PYTHON) benchmark/agreement.py
	for name in $(if $(MEASURED),estimates discretisation accuracy); do $(PYTHON) benchmark/$$name.py; done
	$(if $(MEASURED),,echo 'DLO_DATA names no folder: the tables of measured objects are not made again.')

soak: export OPENBLAS_NUM_THREADS := 1
soak: $(TESTED)
	@$(PYTHON) -m pytest --quiet -m 'hypothesis or long' --hypothesis-profile soak --numprocesses $$(nproc)
	$(PYTHON) test/soak/soak.py | tee benchmark/results/soak.md

figures: bench
	@$(PYTHON) benchmark/searches.py
	$(PYTHON) benchmark/ladder.py
	$(PYTHON) benchmark/export_mujoco.py cantilever hanging flexcomp minute
	$(PYTHON) benchmark/export_mujoco.py trials $(if $(MEASURED),--other)
	$(PYTHON) benchmark/capture.py
	if [ -n "$(MEASURED)" ]; then $(PYTHON) benchmark/mistakes.py; fi
	$(PYTHON) benchmark/first_day.py
	if ! pkg-config --exists ignition-physics5 sdformat12 2>/dev/null; then
	  echo 'Gazebo Fortress is not installed: the table export_sdf is not made again.'
	elif [ -n "$(MEASURED)" ]; then $(PYTHON) benchmark/export_sdf.py build/fitted; fi
	if ! $(PYTHON) -c 'import newton, pxr' 2>/dev/null; then
	  echo 'Newton is not installed: the table export_newton is not made again.'
	elif [ -n "$(MEASURED)" ]; then $(PYTHON) benchmark/export_newton.py build/fitted; fi
	$(PYTHON) -m dlo_calibration experiment --output build/experiment >/dev/null
	cp build/experiment/experiment.md benchmark/results/experiment.md
	$(PYTHON) benchmark/worth.py --output build/experiment >/dev/null
	cp build/experiment/worth.md benchmark/results/worth.md
	cp build/experiment/worth.png doc/worth.png
	for name in routing touching pegs from_photographs live_information $(if $(MEASURED),elastica intervals experiment); do $(PYTHON) benchmark/$$name.py; done
	$(if $(MEASURED),$(PYTHON) benchmark/intervals.py --search random --draws 40)

clean:
	@rm -rf $(VENV) build install log dist *.egg-info .benchmarks .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# uv takes a fifth of the time of pip, but does not see the packages of the machine; pip does where uv cannot.
PIP := $(PYTHON) -m pip --disable-pip-version-check
define prepare
fail() { printf '%s\n' "$$@" >&2; exit 1; }
install() {
  if [ -x $(VENV)/bin/uv ]; then
    index=$${UV_DEFAULT_INDEX-$${PIP_INDEX_URL-$$($(PIP) config get global.index-url 2>/dev/null || true)}}
    UV_DEFAULT_INDEX=$$index $(VENV)/bin/uv pip install --quiet --python $(PYTHON) "$$@" && return
    echo 'uv cannot install this; pip tries.'
  fi
  $(PIP) install --quiet "$$@" $(NUMPY)
}
# An extra without the package itself, which would be compiled again.
extra() {
  install $$($(PYTHON) -c "from importlib.metadata import requires; print(*(
    one.partition(';')[0] for one in requires('dlo_calibration') if 'extra == \"$$1\"' in one))")
}
endef

# Where Python has no headers, those of its package lie in .venv, without having been installed.
define with_headers
for headers in $(abspath $(VENV))/headers/usr/include/python*; do
  [ ! -e "$$headers" ] || export CPATH=$$headers:$${headers%/*}$${CPATH:+:$$CPATH}
done
endef

$(STAMP): setup.py pyproject.toml $(CORE)
	@$(prepare)
	base=
	for candidate in $(CANDIDATES); do
	  if $$candidate -c 'import sys; sys.exit(sys.version_info[:2] not in [(3, 11), (3, 12)])' 2>/dev/null; then
	    base=$$candidate; break
	  fi
	done
	[ -n "$$base" ] || fail 'Found none of: $(CANDIDATES), of version 3.11 or 3.12.' \
	  'Install Python 3.11 or 3.12, with its venv module, and try again.'
	$$base -c 'import venv, ensurepip' 2>/dev/null || fail "$$base has no venv module." \
	  'Install it (Debian, Ubuntu: sudo apt install python3-venv) and try again.'
	if [ ! -e $(STAMP) ]; then $$base -m venv --clear $(VENV_OPTIONS) $(VENV); fi
	if ! $$base -c 'import os, sysconfig; os.stat(sysconfig.get_path("include") + "/Python.h")' 2>/dev/null; then
	  package=lib$$($$base -c 'import sys; print("python%d.%d" % sys.version_info[:2])')-dev
	  mkdir -p $(VENV)/headers
	  (cd $(VENV)/headers && apt-get download -qq $$package 2>/dev/null && dpkg -x $$package*.deb .) ||
	    fail "$$base has no headers, which compiling needs, and $$package cannot be downloaded." \
	    'Install them (Debian, Ubuntu: sudo apt install python3-dev) and try again.'
	  echo "$$base has no headers: those of $$package are in $(VENV)/headers."
	fi
	$(with_headers)
	echo "Installing into $(VENV) with $$($(PYTHON) --version); ROS comes from $(ROS). This takes a minute or less."
	[ $(ROS) = machine ] || $(PIP) install --quiet uv || echo 'There is no uv: pip installs, which takes longer.'
	if [ -n '$(ZIG)' ]; then
	  echo 'There is no C++ compiler: Zig is installed from PyPI. The first time, it takes two minutes more.'
	  $(PIP) install --quiet $(ZIG)
	fi
	install --editable '.$(EXTRA)'
	$(PYTHON) -c 'import pybullet' >/dev/null 2>&1 ||
	  echo 'PyBullet has no binary for this Python, so no second engine confirms results: make test adds it.'
	touch $@

$(TESTED): $(STAMP)
	@$(prepare)
	echo 'Installing what tests need besides.'
	extra test
	if ! $(PYTHON) -c 'import pybullet' >/dev/null 2>&1; then
	  echo 'PyBullet has no binary for this Python: it is compiled now, which takes about four minutes.'
	  extra bullet ||
	    echo 'PyBullet is missing, so its tests are skipped: sudo apt install build-essential adds a compiler.'
	fi
	touch $@
