# Every command of the README. The first one makes .venv (once, a few minutes); after that each starts at once.
# Works with GNU make 3.81 (macOS) and later.

# `make TARGET VARIABLE=value ...`: a variable is a flag of the target's command, so SEED=1 is --seed 1. The command has
# its own default for every flag that is not given.
## ROBOT        a folder under robots/ (default: g1)
## TARGETS      clips to forget, comma-separated (default: the robot's; g1: punch,kick)
## METHOD       how to forget; `make unlearn ARGS=--help` names them (default: arft)
## LAMBDA       the penalty λ on the targets' tracking reward, --penalty (default: 16)
## PRESET       cpu or paper (default: cpu)
## LIBRARY      folder of clips (default: data/ROBOT)
## BASE         the policy to start from (default: the shipped one; for pretrain and train, none)
## BASES        the policies that sweep and experiments start from, comma-separated (default: the shipped one; for
##              experiments every data/ROBOT/base*)
## CONTROLS     retrained controls for the experiments, comma-separated (default: every data/ROBOT/control*)
## WITHOUT      clips that pretrain leaves out, comma-separated, which makes a retrained control (default: none)
## CHECKPOINT   the policy to evaluate, export, play or film (default: the shipped base; to play or film, all shipped)
## BESIDE       more checkpoints to play or film beside it, comma-separated
## RUN          folder of the run to attack, or to report on; to attack several, comma-separated
## OUTPUT       where the results go (default: under runs/)
## NOISE        1 evaluates with randomisation, pushes and sensor noise
## RESUME       1 continues the run in OUTPUT
## SWEEP        lambda, targets, sampler or seeds (default: lambda)
## DEVICES      devices that share one training, such as 4; for bench the numbers to compare, such as 1,2,4 (default: 1)
## SEEDS        runs of each kind for sweep and experiments (default: 3, from several bases 1); for pretrain so many
##              trainings, each in a folder of its own
## JOBS         of these, so many at a time on this machine (default: one on each GPU)
## CLUSTER      address of a dask scheduler whose workers run them (docs/cluster.md; default: none)
## ARGS         flags as they are, and what comes before them; ARGS=--help lists all flags
## PYTHON       the Python that .venv is made from, 3.11 to 3.14 (default: the first found)
PROGRAM = .venv/bin/python -m forgetmimic_jax
SWITCHES = RESUME NOISE WRENCH DRAW DRY FORCE MIX_COMMITS NO_STOP FULL FAKES KEEP_HEIGHT FILL_MISSING

# The variables of the command line as flags; a switch has no value.
given = $(foreach name,$(.VARIABLES),$(if $(filter command,$(origin $(name))),$(name)))
flag_name = $(subst lambda,penalty,$(shell echo $(1) | tr A-Z_ a-z-))
flag_value = $(if $(filter $(1),$(SWITCHES)),$(filter-out 1,$($(1))),'$(subst ','\'',$($(1)))')
flag = $(if $($(1)),--$(call flag_name,$(1)) $(call flag_value,$(1)))
FLAGS = $(foreach name,$(filter-out ARGS PYTHON SWEEP,$(given)),$(call flag,$(name)))

COMMANDS = pretrain train unlearn evaluate evidence export play video report motions robot import-policy bench
STUDIES = validity comparison penalty heat_map motion_types physical_behaviour training_dynamics relearning membership \
	number_of_targets stand overlap generality from_scratch

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help $(COMMANDS) sweep experiments tables test mutants soak lint format clean

help: ## this list
	@echo 'make TARGET [VARIABLE=value ...]'
	@echo
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1|\2/p' Makefile | \
		while IFS='|' read -r name text; do printf '  %-13s %s\n' "$$name" "$$text"; done
	@echo
	@sed -n 's/^## /  /p' Makefile

pretrain: ## train a base policy on every clip of LIBRARY, in phases, unattended (hours)
train: ## train by plain PPO, as the paper does
unlearn: ## forget TARGETS, then evaluate base and unlearned policy side by side
evaluate: ## evaluate CHECKPOINT clip by clip
evidence: ## try to bring back what the run in RUN forgot, and judge it (20 minutes; ARGS=--full: hours)
export: ## write CHECKPOINT as ONNX for deploy tools, checked in plain MuJoCo
play: ## watch CHECKPOINT live in a web page, beside its base
video: ## film CHECKPOINT clip by clip, beside its base: MP4, GIF and a page of stills
report: ## write one HTML page about the unlearning run in RUN
robot: ## make a robot of a vendor's MJCF (ARGS=--help says how)
motions: ## make a library from your own clips (ARGS=--help says how)
import-policy: ## make a base of policies of other projects (ARGS="a.onnx b.onnx")
bench: ## measure the speed of training on this machine
$(COMMANDS): .venv/.installed
	$(PROGRAM) $@ $(strip $(ARGS) $(FLAGS))

sweep: .venv/.installed ## several unlearning runs that differ in one thing, with table and figure
	$(PROGRAM) sweep $(or $(SWEEP),lambda) $(strip $(ARGS) $(FLAGS))

experiments: .venv/.installed ## run what is missing of the paper's studies (hours), then write their pages
	@status=0; for study in $(STUDIES) 'stand --robot h2'; do \
		MUJOCO_GL=disable .venv/bin/python -m experiments.$$study $(strip $(ARGS) $(FLAGS)) || status=$$?; \
		test $$status -lt 128 || break; \
	done; .venv/bin/python -m experiments.claims; exit $$status

tables: .venv/.installed ## rewrite the README's tables and the studies' pages from the stored numbers alone
	.venv/bin/python -m forgetmimic_jax.evaluation.tables README.md
	@for study in $(STUDIES); do \
		for robot in $(notdir $(wildcard robots/*)); do \
			test ! -f experiments/results/$$robot/$$study.json || \
				.venv/bin/python -m experiments.$$study --robot $$robot --draw || exit; \
		done; \
	done
	.venv/bin/python -m experiments.claims

test: .venv/.installed .venv/.warp ## run the tests
	.venv/bin/python -m pytest --numprocesses=logical --maxprocesses=4 --dist=loadfile --no-loadscope-reorder $(ARGS)

mutants: .venv/.installed ## see which faults of one line the tests notice (half an hour; ARGS=--list names them)
	.venv/bin/python tests/mutants.py $(ARGS)

soak: .venv/.installed ## kill, fill, mutate and train random policies: hours of faults on purpose (ARGS=--help lists the parts)
	.venv/bin/python tests/soak.py $(ARGS)

# Warp takes 400 MB. Without a GPU only the tests of mjx-warp use it; where it has no wheel they are left out.
.venv/.warp: requirements-warp.lock .venv/.installed
	@.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps -r $< || echo 'no Warp here'
	@touch $@

lint: .venv/.installed ## check style, formatting and types
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy forgetmimic_jax experiments

format: .venv/.installed ## put the code in its format
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

clean: ## remove caches and build leftovers, also the compiled programs; runs/ and .venv stay
	rm -rf .pytest_cache .ruff_cache .mypy_cache build *.egg-info "$${XDG_CACHE_HOME:-$$HOME/.cache}/forgetmimic-jax"
	find forgetmimic_jax tests experiments -name __pycache__ -prune -exec rm -rf {} +

.venv/.installed: requirements.lock pyproject.toml
	@for python in $(if $(PYTHON),$(PYTHON),python3 python3.14 python3.13 python3.12 python3.11); do \
		if $$python -c 'import sys, ensurepip; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' 2>/dev/null; then \
			echo "making .venv with $$($$python --version) (once, a few minutes)"; \
			exec $$python -m venv .venv; \
		fi; \
	done; \
	echo 'error: needs Python 3.11, 3.12, 3.13 or 3.14 with its venv module; name one with PYTHON=/path/to/python' >&2; exit 2
	.venv/bin/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@
