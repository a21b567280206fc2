# Every target sets up what it needs, in .venv.  With ROS 2 Jazzy sourced, the machine's client library is
# used; else the same library comes from PyPI, for Python 3.11 or 3.12.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help
.PHONY: help demo experiment test lint bench soak figures clean

VENV := .venv
PYTHON := $(VENV)/bin/python
# Without bytecode, each of the many processes of a test compiles all that it imports.
unexport PYTHONDONTWRITEBYTECODE
MEASURED := $(wildcard $(or $(DLO_DATA),../shared/data))
LINT := test/test_lint.py test/test_copyright.py test/test_architecture.py test/test_packaging.py

ifeq ($(shell test "$${ROS_DISTRO-}" = jazzy && python3 -c 'import rclpy' 2>/dev/null && echo yes),yes)
# numpy 2 cannot load message types that were built against numpy 1.
ROS := machine
CANDIDATES := python3
VENV_OPTIONS := --system-site-packages
REQUIREMENTS := '.[test]' 'numpy<2'
else
# Libraries of another ROS or of another environment must not mix with those of .venv.
ROS := pypi
CANDIDATES := python3.11 python3 python3.12
VENV_OPTIONS :=
REQUIREMENTS := '.[ros,test]'
unexport PYTHONPATH PYTHONHOME LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
export AMENT_PREFIX_PATH := $(abspath $(VENV))
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
endif
STAMP := $(VENV)/installed-with-ros-from-$(ROS)

help:
	@cat <<-END
	  make demo    calibrate a sample session with the real node, and draw the result
	  make test    run the tests; some that take long are left to make soak
	  make experiment   repeat the paper's experiment on the samples: consistency and validity, as tables;
	               then execute plans with fitted, default and true parameters: what calibration is worth
	  make lint    run the checks of style, types, imports and packaging alone
	  make bench   measure speed, memory, start-up and accuracy, and compare the engines: about 25 minutes
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
test: $(STAMP)
	@cores=$$(nproc)
	$(PYTHON) -m dlo_calibration warm-up  # once for all processes of the tests
	$(PYTHON) -m pytest --numprocesses $$((cores < 4 ? cores + 1 : 4)) --dist worksteal --durations 10 $(ARGUMENTS)

lint: $(STAMP)
	@$(PYTHON) -m pytest -m '' $(LINT)

bench: $(STAMP)
	@$(PYTHON) -c 'import mujoco' 2>/dev/null ||
	  $(PYTHON) -m pip install --quiet --disable-pip-version-check --editable '.[bench]'
	$(PYTHON) -m pytest benchmark
	$(PYTHON) benchmark/agreement.py
	for name in $(if $(MEASURED),estimates discretisation accuracy); do $(PYTHON) benchmark/$$name.py; done
	$(if $(MEASURED),,echo 'DLO_DATA names no folder: the tables of measured objects are not made again.')

soak: export OPENBLAS_NUM_THREADS := 1
soak: $(STAMP)
	@$(PYTHON) -m pytest --quiet -m 'hypothesis or long' --hypothesis-profile soak --numprocesses $$(nproc)
	$(PYTHON) test/soak/soak.py | tee benchmark/results/soak.md

figures: bench
	@$(PYTHON) benchmark/searches.py
	$(PYTHON) benchmark/ladder.py
	$(PYTHON) benchmark/export_mujoco.py cantilever hanging flexcomp minute
	$(PYTHON) benchmark/export_mujoco.py trials $(if $(MEASURED),--other)
	$(PYTHON) benchmark/capture.py
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
	for name in from_photographs live_information $(if $(MEASURED),elastica intervals experiment); do $(PYTHON) benchmark/$$name.py; done
	$(if $(MEASURED),$(PYTHON) benchmark/intervals.py --search random --draws 40)

clean:
	@rm -rf $(VENV) build install log dist *.egg-info .benchmarks .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMP): setup.py
	@fail() { printf '%s\n' "$$@" >&2; exit 1; }
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
	echo "Installing into $(VENV) with $$($(PYTHON) --version); ROS comes from $(ROS). This takes a minute or two."
	if $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 12))' &&
	    ! $(PYTHON) -c 'import pybullet' 2>/dev/null; then
	  command -v c++ >/dev/null || fail 'PyBullet must be compiled for this Python, and there is no C++ compiler.' \
	    'Install one (Debian, Ubuntu: sudo apt install build-essential python3-dev), or Python 3.11.'
	  echo 'PyBullet has no binary for this Python: it is compiled now, which takes about four minutes more.'
	fi
	$(PYTHON) -m pip install --quiet --disable-pip-version-check --editable $(REQUIREMENTS)
	$(PYTHON) -m dlo_calibration warm-up
	touch $@
