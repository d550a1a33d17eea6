# banmo-pipeline: videos in, animatable 3D model out.   make help
#
#   make reconstruct VIDEOS=clips/      your clips (without VIDEOS: sample clips made on the spot)
#   make test                           every test
#
# Each target sets itself up on a fresh machine: Python 3.11 or newer with venv is all it needs.

PY        ?= python3
VENV      ?= .venv
TORCH     ?= torch==2.13.0
PIP       ?= "$(VENV)/bin/python" -m pip --disable-pip-version-check

VIDEOS    ?=
WORKSPACE ?= workspace
PRESET    ?=
STAGE     ?=
VIDEO     ?=
ARGS      ?=
# Bounds soak and fuzz (10 unless given) and train-networks (120)
MINUTES   ?=
# Evaluation data and script of your own; see benchmarks/
DATA      ?=
LOOK      ?= clean
EVALUATE  ?=

# On a CPU shared with others, OpenMP threads that spin while they wait make torch many times slower.
export GOMP_SPINCOUNT ?= 2000

SHELL  := /bin/bash
BANMO   = "$(VENV)/bin/banmo"
PYTHON  = "$(VENV)/bin/python"
SAMPLES = build/sample-clips
# A stamp, not the folder, says that set-up is complete; a changed pyproject.toml sets up again.
STAMP   = $(subst $(space),\ ,$(VENV))/.ready
empty  :=
space  := $(empty) $(empty)

.DEFAULT_GOAL := help
.PHONY: help setup reconstruct stage status why inspect verify samples test soak fuzz test-slurm lint bench score train-networks docs clean

help:  ## this list
	@awk -F ':.*##' '/^[a-z-]+:.*##/ {printf "  make %-12s %s\n", $$1, $$2}' Makefile
	@echo
	@echo "  VIDEOS=clips/  WORKSPACE=workspace  PRESET=preview  STAGE=masks  VIDEO=cat-00  ARGS='--fit.minutes 3'"

setup: $(STAMP)  ## a virtual environment with everything in it
$(STAMP): pyproject.toml
	"$(PY)" -c 'import sys; sys.exit("Python 3.11 or newer is needed; this is " + sys.version.split()[0] + "; name another with PY=") if sys.version_info < (3, 11) else None'
	test -x "$(VENV)/bin/python" || "$(PY)" -m venv "$(VENV)"
	$(PIP) install -q "$(TORCH)"
	$(PIP) install -q -e '.[dev]'
	touch "$(VENV)/.ready"

samples: $(STAMP)  ## three short clips of a generated animal, in build/sample-clips
	@test -n "$$(ls $(SAMPLES)/*.mp4 2>/dev/null)" || { rm -rf $(SAMPLES).part && \
	  $(PYTHON) -m synthetic.clips $(SAMPLES).part && rm -rf $(SAMPLES) && mv $(SAMPLES).part $(SAMPLES); }

ifeq ($(strip $(VIDEOS)),)
reconstruct: samples
endif
reconstruct: $(STAMP)  ## clips in VIDEOS -> WORKSPACE/exports/model.glb
	@$(BANMO) run "$(if $(strip $(VIDEOS)),$(VIDEOS),$(SAMPLES))" --workspace "$(WORKSPACE)" $(if $(PRESET),--preset "$(PRESET)") $(if $(STAGE),--stage "$(STAGE)") $(ARGS)

stage: $(STAMP)  ## run again one STAGE and what it needs
	@test -n "$(STAGE)" || { echo "say which: make stage STAGE=masks"; exit 2; }
	@$(BANMO) run $(if $(VIDEOS),"$(VIDEOS)") --workspace "$(WORKSPACE)" --stage "$(STAGE)" $(ARGS)

status: $(STAMP)  ## what is done, what is to do
	@$(BANMO) status --workspace "$(WORKSPACE)" $(ARGS)

why: $(STAMP)  ## why STAGE (of VIDEO) would run
	@test -n "$(STAGE)" || { echo "say which: make why STAGE=masks"; exit 2; }
	@$(BANMO) why "$(STAGE)" $(if $(VIDEO),"$(VIDEO)") --workspace "$(WORKSPACE)" $(ARGS)

inspect: $(STAMP)  ## what is in the result of STAGE (of VIDEO)
	@test -n "$(STAGE)" || { echo "say which: make inspect STAGE=masks"; exit 2; }
	@$(BANMO) inspect "$(STAGE)" $(if $(VIDEO),"$(VIDEO)") --workspace "$(WORKSPACE)" $(ARGS)

verify: $(STAMP)  ## read every stored byte and compare digests
	@$(BANMO) verify --deep --workspace "$(WORKSPACE)" $(ARGS)

test: $(STAMP)  ## every test
	$(PYTHON) -m pytest $(ARGS)

soak: $(STAMP)  ## kill writers 500 times and whole runs 20 times; compare with undisturbed ones (MINUTES bounds it)
	BANMO_SOAK_KILLS=500 BANMO_SOAK_MINUTES=$(or $(MINUTES),10) $(PYTHON) -m pytest tests/crash/test_crash_soak.py -s $(ARGS)
	BANMO_MODEL_EXAMPLES=400 $(PYTHON) -m pytest tests/crash/test_crash_model.py $(ARGS)
	BANMO_RUN_KILLS=20 $(PYTHON) -m pytest tests/crash/test_crash_kill.py $(ARGS)
	BANMO_FULL_DISKS=32 BANMO_FAULT_RUNS=16 BANMO_GC_ROUNDS=12 $(PYTHON) -m pytest tests/crash/test_crash_faults.py $(ARGS)
	BANMO_SOAK=20 $(PYTHON) -m pytest tests/end_to_end/test_kill.py -s $(ARGS)

fuzz: $(STAMP)  ## 100,000 damaged inputs for each reader of foreign files (MINUTES bounds it)
	BANMO_FUZZ=100000 BANMO_FUZZ_MINUTES=$(or $(MINUTES),10) $(PYTHON) -m pytest tests/fuzz -s $(ARGS)

test-slurm: $(STAMP)  ## a real Slurm of two nodes on this machine (Debian: slurm-wlm munge); needs the superuser
	BANMO_SLURM=1 $(PYTHON) -m pytest tests/slurm $(ARGS)

lint: $(STAMP)  ## style, layers and types
	$(PYTHON) -m ruff check .
	$(VENV)/bin/lint-imports
	$(PYTHON) -m mypy pipeline stages synthetic training benchmarks

bench: $(STAMP)  ## reconstruct DATA (given masks and root poses) and score it with EVALUATE
	@test -n "$(DATA)" -a -n "$(EVALUATE)" || { echo "say which: make bench DATA=data/fox EVALUATE=evaluate.py [LOOK=clean]"; exit 2; }
	$(PYTHON) -m benchmarks.tier_a --data "$(DATA)" --look "$(LOOK)" --out "build/bench/$(notdir $(DATA:/=))-$(LOOK)"
	$(BANMO) run "build/bench/$(notdir $(DATA:/=))-$(LOOK)" --workspace "build/bench/$(notdir $(DATA:/=))-$(LOOK)-workspace" $(if $(PRESET),--preset "$(PRESET)") $(ARGS)
	$(PYTHON) -m benchmarks.score --evaluate "$(EVALUATE)" --data "$(DATA)" --look "$(LOOK)" --workspace "build/bench/$(notdir $(DATA:/=))-$(LOOK)-workspace"

score: $(STAMP)  ## score WORKSPACE against DATA with EVALUATE
	@test -n "$(DATA)" -a -n "$(EVALUATE)" || { echo "say which: make score DATA=data/fox EVALUATE=evaluate.py [LOOK=clean]"; exit 2; }
	$(PYTHON) -m benchmarks.score --evaluate "$(EVALUATE)" --data "$(DATA)" --look "$(LOOK)" --workspace "$(WORKSPACE)"

train-networks: $(STAMP)  ## train the shipped networks anew: renderings, MINUTES of training, files in build/networks
	$(PYTHON) -m synthetic.bank build/bank --category quadruped --bodies 180 --views 100 --seed 1
	$(PYTHON) -m synthetic.bank build/bank --category human --bodies 180 --views 100 --seed 1
	$(PYTHON) -m synthetic.bank build/bank --category thing --bodies 120 --views 25 --seed 1
	$(PYTHON) -m training.train build/networks --bank build/bank --minutes "$(or $(MINUTES),120)" --seed 0
	$(PYTHON) -m training.export build/networks/state.safetensors build/networks/weights
	$(PYTHON) -m synthetic.bank build/bank192 --category quadruped --bodies 60 --views 30 --seed 11 --side-px 192
	$(PYTHON) -m synthetic.bank build/bank192 --category human --bodies 60 --views 30 --seed 11 --side-px 192
	$(PYTHON) -m synthetic.bank build/bank192 --category thing --bodies 20 --views 30 --seed 11 --side-px 192
	$(PYTHON) -m training.refine build/networks --bank build/bank192 --start build/networks/state.safetensors --seed 0
	$(PYTHON) -m training.export build/networks/refine.safetensors build/networks/weights
	$(PYTHON) -m training.quantise build/networks/weights

docs: $(STAMP)  ## write the settings template and the settings page from the code
	$(PYTHON) docs/generate.py

clean:  ## remove build products; workspaces and the environment stay
	rm -rf build .pytest_cache .hypothesis .ruff_cache .import_linter_cache
