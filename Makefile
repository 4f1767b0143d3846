# Everything from a bare machine with Python 3.10-3.13, make and a C compiler. Each target builds .venv when needed.
PYTHON ?= python3
EXTRAS ?= ros,train,tensorboard,gym,examples,test,colcon
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

# The environment is closed: nothing of a sourced ROS installation or another venv shines in.
unexport PYTHONPATH PYTHONHOME AMENT_PREFIX_PATH COLCON_PREFIX_PATH
ifdef _ROS_WHEELS_BOOTSTRAP_COMPLETE
unexport LD_LIBRARY_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
endif
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := help
.PHONY: help venv demo test test-slow measure lint format shipped-policy field-card clean

help:
	@echo 'make demo       record experts, learn from their bags, drive the plant: out/demo'
	@echo 'make test       the tests, without the slow ones'
	@echo 'make test-slow  the slow ones'
	@echo 'make measure    the figures of docs/measured.md, 90 minutes on an idle machine'
	@echo 'make lint       ruff and mypy'
	@echo 'make format     let ruff format the code'
	@echo 'make shipped-policy  train the policy that ships, tractor_sim/data/policy'
	@echo 'make venv       build .venv only (EXTRAS=$(EXTRAS))'
	@echo 'make clean      remove .venv, builds, caches and out/demo'

venv: $(STAMP)

# setuptools comes first: the package is then built with the tested version, not in isolation.
$(STAMP): setup.py setup.cfg pyproject.toml package.xml requirements.lock
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; \
	  sys.exit(None if (3, 10) <= v <= (3, 13) else "needs Python 3.10 to 3.13, %s is %d.%d: set PYTHON=" % (sys.executable, *v))'
	@echo 'building $(VENV): about a minute, more when downloads are slow'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -qq -c requirements.lock setuptools
	@$(BIN)/python -m pip install -qq -c requirements.lock --no-build-isolation -e '.[$(EXTRAS)]'
	@touch $@

demo: $(STAMP)
	$(BIN)/ems demo $(DEMO_ARGS)

# A file of tests stays in one process: its fixtures are made, and its loops compiled, once. No two
# graphs of nodes run at a time (test/conftest.py).
test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'not slow' $(PYTEST_ARGS)

test-slow: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m slow $(PYTEST_ARGS)

# Each writes its section of docs/data/measured.json, from which the page is made.
measure: $(STAMP)
	$(BIN)/python test/nodes/measure_reactions.py --trials 50 --record reactions
	$(BIN)/python test/nodes/measure_faults.py --trials 5 --record faults
	$(BIN)/python test/nodes/measure_real_time.py --seconds 600 --record real_time
	rm -rf out/measured
	$(BIN)/python test/signals/vehicle_bag.py out/measured/v21
	$(BIN)/ems train --bags out/measured/v21 --signals example_vehicle \
	  --powertrain paper:dt_s=0.1 --out out/measured/tractor.safetensors
	$(BIN)/python test/nodes/measure_real_time.py --seconds 600 --policy out/measured/tractor.safetensors --record learnt
	$(BIN)/python test/nodes/measure_signals.py --trials 50 --record signals
	$(BIN)/python test/nodes/measure_handover.py --trials 100 --record handover
	$(BIN)/python test/nodes/measured_table.py

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# DP and rule-based runs on twelve training cycles, then training from those bags alone.
SHIPPED := tractor_sim/data/policy
shipped-policy: $(STAMP)
	rm -rf out/shipped
	for seed in 1 2 3 4 5 6 8 9 10 11 12 13; do for policy in dp rule_based; do \
	  $(BIN)/ems evaluate --policy $$policy --cycle planter_$$seed --soc-target 0.836 \
	    --record out/shipped/$${policy}_planter_$$seed >/dev/null || exit; done; done
	$(BIN)/ems train --bags out/shipped --out out/shipped/paper.safetensors
	mkdir -p $(SHIPPED) && cp out/shipped/paper.safetensors $(SHIPPED)/

# The card of the field policy, with its scores in the held-out study.
field-card: $(STAMP)
	$(BIN)/ems policy card field --scores docs/data/held_out.json --out $(SHIPPED)/field.md

clean:
	rm -rf $(VENV) build dist install log out/demo *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
