# Every command of the README. The first one makes .venv (once, a few minutes); after that each starts at once.
# Works with GNU make 3.81 (macOS) and later.

# Variables: `make TARGET VARIABLE=value`. A command gets those that are set and keeps its own default for the others.
## ROBOT        a folder under robots/ (default: g1)
## TARGETS      clips to forget, comma-separated (default: the robot's; g1: punch,kick)
## LAMBDA       penalty on the targets' tracking reward (default: 16)
## METHOD       how to forget; `make unlearn ARGS=--help` names them (default: arft)
## PRESET       cpu or paper (default: cpu)
## PHYSICS      auto, native, mjx or mjx-warp (default: auto)
## LIBRARY      folder of clips (default: data/ROBOT)
## ITERATIONS   training iterations
## SEED         random seed
## BASE         the policy to start from (default: the shipped one; for pretrain, none)
## CHECKPOINT   the policy to evaluate, export, play or film (default: the shipped base)
## CLIPS        clips to film, comma-separated (default: all)
## EPISODES     episodes a clip in an evaluation (default: 20; export: 2)
## RUN          folder of the run to report on
## OUTPUT       folder for the results, for export and report the file (default: under runs/)
## RESUME       1 goes on with the run in OUTPUT
## SWEEP        lambda, targets, sampler or seeds (default: lambda)
## ARGS         any other flags, as they are; ARGS=--help lists them
## PYTHON       the Python that .venv is made from, 3.11 to 3.13 (default: the first found)
ROBOT ?= g1

MODULE = .venv/bin/python -m forgetmimic_jax
flag = $(if $($(2)),--$(1) $($(2)))
WHERE_FLAGS = $(call flag,physics,PHYSICS) $(call flag,library,LIBRARY)
ROBOT_FLAGS = --robot $(ROBOT) $(WHERE_FLAGS)
RUN_FLAGS = $(ROBOT_FLAGS) $(call flag,seed,SEED) $(call flag,output,OUTPUT)
TRAIN_FLAGS = $(RUN_FLAGS) $(call flag,preset,PRESET) $(call flag,iterations,ITERATIONS) $(call flag,base,BASE) \
	$(if $(RESUME),--resume)
TARGET_FLAGS = $(call flag,targets,TARGETS) $(call flag,episodes,EPISODES)
# A study has a robot of its own, the G1 but for one, unless another is asked for.
STUDY_FLAGS = $(if $(filter-out g1,$(ROBOT)),--robot $(ROBOT)) $(WHERE_FLAGS) $(call flag,base,BASE) $(TARGET_FLAGS) \
	$(call flag,budget,PRESET) $(call flag,iterations,ITERATIONS)
STUDIES = validity comparison penalty heat_map motion_types physical_behaviour training_dynamics relearning membership \
	number_of_targets

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help unlearn sweep experiments pretrain evaluate export play report video motions bench tables test mutants lint format clean

help: ## this list
	@echo 'make TARGET [VARIABLE=value ...]'
	@echo
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/\1|\2/p' Makefile | \
		while IFS='|' read -r name text; do printf '  %-12s %s\n' "$$name" "$$text"; done
	@echo
	@sed -n 's/^## /  /p' Makefile

unlearn: .venv/.installed ## forget TARGETS, then evaluate base and unlearned policy side by side
	$(MODULE).unlearn $(strip $(TRAIN_FLAGS) $(TARGET_FLAGS) $(call flag,penalty,LAMBDA) $(call flag,method,METHOD) $(ARGS))

sweep: .venv/.installed ## several unlearning runs that differ in one thing, with table and figure
	$(MODULE).sweep $(or $(SWEEP),lambda) $(strip $(STUDY_FLAGS) $(call flag,output,OUTPUT) $(ARGS))

experiments: .venv/.installed ## run what is missing of the paper's studies (hours), then write their pages
	@status=0; for study in $(STUDIES); do \
		.venv/bin/python -m experiments.$$study $(strip $(STUDY_FLAGS) $(ARGS)) || status=$$?; \
		test $$status -lt 128 || break; \
	done; .venv/bin/python -m experiments.claims; exit $$status

pretrain: .venv/.installed ## train a base policy on every clip
	$(MODULE).train $(strip $(TRAIN_FLAGS) $(ARGS))

evaluate: .venv/.installed ## evaluate CHECKPOINT clip by clip
	$(MODULE).evaluate $(strip $(RUN_FLAGS) $(TARGET_FLAGS) $(call flag,checkpoint,CHECKPOINT) $(ARGS))

export: .venv/.installed ## write CHECKPOINT as ONNX for deploy tools, checked in plain MuJoCo
	$(MODULE).export $(strip --robot $(ROBOT) $(call flag,library,LIBRARY) $(call flag,seed,SEED) \
		$(call flag,output,OUTPUT) $(call flag,checkpoint,CHECKPOINT) $(call flag,episodes,EPISODES) $(ARGS))

play: .venv/.installed ## watch CHECKPOINT live in a web page, beside its base
	$(MODULE).play $(strip --robot $(ROBOT) $(call flag,library,LIBRARY) $(call flag,seed,SEED) \
		$(call flag,checkpoint,CHECKPOINT) $(call flag,base,BASE) $(ARGS))

video: .venv/.installed ## film CHECKPOINT clip by clip, beside its base: MP4, GIF and a page of stills
	$(MODULE).video $(strip --robot $(ROBOT) $(call flag,library,LIBRARY) $(call flag,seed,SEED) \
		$(call flag,output,OUTPUT) $(call flag,checkpoint,CHECKPOINT) $(call flag,base,BASE) \
		$(call flag,clips,CLIPS) $(ARGS))

report: .venv/.installed ## one HTML page that tells of the unlearning run in RUN
	$(MODULE).report $(strip $(call flag,run,RUN) $(call flag,output,OUTPUT) $(ARGS))

motions: .venv/.installed ## make a library from your own clips (ARGS=--help says how)
	$(MODULE).motions $(strip --robot $(ROBOT) $(ARGS))

bench: .venv/.installed ## steps per second of training on this machine
	$(MODULE).bench $(strip $(ROBOT_FLAGS) $(call flag,preset,PRESET) $(ARGS))

tables: .venv/.installed ## rewrite the README's tables and the studies' pages from the stored numbers alone
	$(MODULE).evaluation.tables README.md
	@for study in $(STUDIES); do \
		for robot in $(notdir $(wildcard robots/*)); do \
			test ! -f experiments/results/$$robot/$$study.json || \
				.venv/bin/python -m experiments.$$study --robot $$robot --draw || exit; \
		done; \
	done
	.venv/bin/python -m experiments.claims

test: .venv/.installed ## run the tests
	.venv/bin/python -m pytest $(ARGS)

mutants: .venv/.installed ## see which faults of one line the tests notice (half an hour; ARGS=--list names them)
	.venv/bin/python tests/mutants.py $(ARGS)

lint: .venv/.installed ## check style, formatting and types
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy forgetmimic_jax experiments

format: .venv/.installed ## put the code in its format
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

clean: ## remove caches and build leftovers; runs/ and .venv stay
	rm -rf .pytest_cache .ruff_cache .mypy_cache build *.egg-info
	find forgetmimic_jax tests experiments -name __pycache__ -prune -exec rm -rf {} +

.venv/.installed: requirements.lock pyproject.toml
	@for python in $(if $(PYTHON),$(PYTHON),python3 python3.13 python3.12 python3.11); do \
		if $$python -c 'import sys, ensurepip; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null; then \
			echo "making .venv with $$($$python --version) (once, a few minutes)"; \
			exec $$python -m venv .venv; \
		fi; \
	done; \
	echo 'error: needs Python 3.11, 3.12 or 3.13 with its venv module; name one with PYTHON=/path/to/python' >&2; exit 2
	.venv/bin/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	.venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $@
