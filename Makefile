# Everything a newcomer or CI needs. `make help` lists the targets.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
EXTRAS := dev,mlflow,wandb,tensorboard,view,box2d,metaworld,highway,coppeliasim,cognition,onnx,docs
# Two cores learn as fast as one on small networks, but two test workers halve the waiting.
WORKERS ?= 2
# Which benchmarks `make bench` runs; empty: all up to an hour each.
BENCH ?=
# Further settings of `make demo`, such as DEMO=n_epochs=1.
DEMO ?=

# No program that is started here shall report about its users.
export DO_NOT_TRACK ?= true
export MLFLOW_DISABLE_TELEMETRY ?= true

SHELL := bash
.DEFAULT_GOAL := help
.PHONY: help setup check format test test-slow smoke performance test-myosuite bench demo docs docs-figures gallery figure-fetchpush mlflow audit clean-venv

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	  { echo "Scilab-RL needs Python 3.10 or newer; found $$($(PYTHON) --version). Try: make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 2; }
	@echo "Installing Scilab-RL and its libraries into $(VENV): about 3.3 GB, usually 2 to 5 minutes."
	@echo "Smaller, without trackers, viewer and some environments: make setup EXTRAS=jax (README)."
	@$(PYTHON) -m venv $(VENV)
	@set -o pipefail; $(BIN)/pip install --progress-bar off -c constraints.txt -e ".[$(EXTRAS)]" \
	  | tee $(VENV)/install.log | awk -f scripts/show_progress.awk
	@touch $@
	@[ "$(MAKECMDGOALS)" != setup ] || echo "Ready. Try: make demo"

setup: $(VENV)/.installed  ## create .venv and install the pinned dependencies
	@$(BIN)/python -m scilab_rl.cli.doctor --rendering-hint

# CleanRL's script runs with newer versions than it asks for, see benchmarks/peers/cleanrl_sac.py.
.venv-peers/.installed: benchmarks/peers/requirements.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/pip install --quiet -r benchmarks/peers/requirements.txt
	.venv-peers/bin/pip install --quiet --no-deps --ignore-requires-python cleanrl==1.2.0
	@touch $@

# hBayesDM requires PyStan 2; what is used are its model files and its example data.
.venv-hbayesdm/.installed: benchmarks/peers/hbayesdm.txt
	$(PYTHON) -m venv .venv-hbayesdm
	.venv-hbayesdm/bin/pip install --quiet -r benchmarks/peers/hbayesdm.txt
	.venv-hbayesdm/bin/pip install --quiet --no-deps hbayesdm==1.1.1
	@touch $@

bench: $(VENV)/.installed .venv-peers/.installed .venv-hbayesdm/.installed  ## all benchmarks (hours; BENCH="startup updates": only these)
	$(BIN)/python benchmarks/all.py $(BENCH)

demo: setup  ## train a Fetch robot arm to reach its goal, and film it before, during and after (a minute or two)
	$(BIN)/python src/main.py algorithm=jaxsac env=FetchReach-v4 seed=1 eval_after_n_steps=200 n_epochs=20 early_stop_last_n=6 \
	  render=record render_freq=4 'render_metrics_train=[]' render_view=close \
	  'render_metrics_test=[q_values,goal_distance,reward]' $(DEMO)
	$(BIN)/python src/main.py play last --policy finished --episodes 20 --record
	$(BIN)/python scripts/learning_clip.py last

check: $(VENV)/.installed  ## format, lint, types and import layers, as CI runs them
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/.installed  ## rewrite the code in the project's format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

test: $(VENV)/.installed  ## the fast tests
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

test-slow: $(VENV)/.installed  ## the slow and the performance tests (an hour)
	$(BIN)/python -m pytest -m "slow or performance"

smoke: $(VENV)/.installed  ## run everything that has a YAML file for a second or two (under 10 minutes)
	scripts/run_smoke_tests.sh

performance: $(VENV)/.installed  ## the performance tests of minutes (TIER=nightly: hours, release: all)
	scripts/run_performance_tests.sh --tier $(or $(TIER),pr)

.venv-myosuite/.installed: pyproject.toml constraints-myosuite.txt
	$(PYTHON) -m venv .venv-myosuite
	.venv-myosuite/bin/pip install --quiet -c constraints-myosuite.txt -e ".[dev,myosuite]"
	@touch $@

test-myosuite: .venv-myosuite/.installed  ## the tests of MyoSuite, in a virtual environment of its own
	.venv-myosuite/bin/python -m pytest tests/unit/envs/suites/test_myosuite.py

docs: $(VENV)/.installed  ## build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

docs-figures: $(VENV)/.installed  ## draw the figures of the documentation
	$(BIN)/python -m docs.figures

gallery: setup  ## film the trained agents, see docs/gallery.md (about three minutes)
	$(BIN)/python docs/figures/gallery.py

figure-fetchpush: setup  ## the paper's figure: critic variance while the block falls (about 10 minutes)
	$(BIN)/python src/main.py algorithm=sac_var env=FetchPush-v1 seed=1 n_epochs=6 n_test_rollouts=5 \
	  algorithm.n_critics=4 algorithm.weight_critic_var=0.25 algorithm.learning_rate=1e-3 \
	  algorithm.gamma=0.95 algorithm.tau=0.05 algorithm.learning_starts=1000
	$(BIN)/python scripts/figure_fetchpush.py last --falls 24

mlflow: $(VENV)/.installed  ## browse the learning curves of all runs, on http://127.0.0.1:5000
	$(BIN)/python -m scilab_rl.cli.main mlflow

audit: $(VENV)/.installed  ## report known vulnerabilities of the pinned versions (needs a network)
	@$(BIN)/python scripts/audit.py

clean-venv:  ## remove .venv (nothing else)
	rm -rf $(VENV)
