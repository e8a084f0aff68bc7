# What can be done here: make help
PYTHON ?= python3
BIN := .venv/bin
export PYTHON
CAMPAIGNS ?= ends false_readings demo_seeds random_arms hard_cases kill_sweep kill_records kill_host random_kills daemon_days daemon_kills fuzz_frames fuzz_drives fuzz_guard fuzz_files fault_injection systemd_units kill_drives two_hosts scales web

.DEFAULT_GOAL := help
.PHONY: discovery listening referee external poses weigh long sound hands published elsewhere mutantdraw servopeer repeats motortorque moving fleetdays batched help venv demo test lint format bench soak realtime stalls blind corruptions mutants docs constraints clean realism walk observer wheel firsthour creep creepwalk bodies again laws pictures container lock audit sbom

help: ## Say what can be done
	@sed -n 's/^\([a-z]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | awk -F'\t' '{ printf "make %-12s %s\n", $$1, $$2 }'

.venv/.demo: pyproject.toml constraints.txt scripts/make-venv
	@scripts/make-venv demo

.venv/.dev: .venv/.demo
	@scripts/make-venv dev

venv: .venv/.dev ## Make .venv with the package and everything needed to work on it

demo: .venv/.demo ## The whole job on a simulated arm; writes armlink-demo/report.html (ARGS="--seed 3" goes to armlink demo)
	$(BIN)/armlink demo $(ARGS)

test: .venv/.dev ## Run every test but the long ones, those on real SocketCAN included (ARGS goes to pytest)
	@scripts/install-system
	scripts/run-tests $(ARGS)

lint: .venv/.dev ## Check style, types and the import rules
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

format: .venv/.dev ## Put the code in shape
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

bench: .venv/.dev ## Measure side by side with peers; writes benchmarks/latest.json
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python benchmarks/run.py

referee: .venv/.dev ## One blind benchmark for every tool, an hour on two cores (ARGS="--cases 11 --seed 1 2 --only armlink nominal")
	scripts/referee-tools
	test -d .referee/models || $(BIN)/python -m pip install -q --no-deps --target .referee/models example-robot-data
	PYTHONPATH=benchmarks OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1 \
	  $(BIN)/python -m referee --models .referee/models $(ARGS)

long: .venv/.dev ## The tests that make test leaves out, on real SocketCAN too: more arms, cases and draws (ARGS goes to pytest)
	scripts/run-tests --long $(ARGS)

soak: .venv/.dev ## Long campaigns outside make test: kills, faults, simulated days, random arms (CAMPAIGNS="kill_host web", ARGS)
	@status=0; for name in $(CAMPAIGNS); do \
	  echo "soak: $$name" >&2; $(BIN)/python tests/campaigns/$$name.py $(ARGS) || { status=1; echo "soak: $$name failed" >&2; }; \
	done; exit $$status

realtime: .venv/.dev ## Long campaign outside make test: the whole job between processes, in real time (ARGS="--seeds 1 --busy")
	$(BIN)/python tests/campaigns/real_time.py $(ARGS)

observer: .venv/.dev ## Long campaign outside make test: the observer on arms that are not perfect (ARGS="--draws 20 --only drifts")
	$(BIN)/python tests/campaigns/observer_arms.py $(ARGS)

moving: .venv/.dev ## Long campaign outside make test: changes of arms without torque sensors, found in their work (ARGS="--draws 10")
	$(BIN)/python tests/campaigns/moving_arms.py $(ARGS)

stalls: .venv/.dev ## Long campaign outside make test: sweeps while job, loop and arm are stopped, and on a busy machine
	$(BIN)/python tests/campaigns/stalls.py $(ARGS)

creep: .venv/.dev ## Long campaign outside make test: drawn arms without torque sensors (ARGS="--seeds 1 5 --no-steps")
	$(BIN)/python tests/campaigns/creep_contacts.py
	$(BIN)/python tests/campaigns/creep_float.py
	$(BIN)/python tests/campaigns/creep_arms.py $(ARGS)

creepwalk: .venv/.dev ## Long campaign outside make test: the procedure of the demo openarm in real time over udp_multicast: docs/no-torque-sensors.md typed in order (ARGS="--out DIR")
	$(BIN)/python tests/campaigns/creep_walk.py $(ARGS)

listening: .venv/.dev ## Long campaign outside make test: minutes beside a ROS 2 publisher and a LeRobot-like loop (ARGS="--minutes 10 --only ros2")
	$(BIN)/python tests/campaigns/listening.py $(ARGS)

discovery: .venv/.dev ## Long campaign outside make test: each family's bus found, written, checked and swept in real time (ARGS="--only six-odrive")
	$(BIN)/python tests/campaigns/discovery.py $(ARGS)

poses: .venv/.dev ## Long campaign outside make test: gravity of drawn arms from poses at rest, and of 3,000 real poses (ARGS="--draws 40 --seed 0")
	$(BIN)/python tests/campaigns/poses.py $(ARGS)

external: .venv/.dev ## Long campaign outside make test: external torque of drawn arms at work (ARGS="--draws 2 --minutes 5 --only motor")
	$(BIN)/python tests/campaigns/external_torque.py $(ARGS)

weigh: .venv/.dev ## Long campaign outside make test: payloads weighed on realistic arms after their own sweeps (ARGS="--draws 40 --seed 0")
	$(BIN)/python tests/campaigns/weigh.py $(ARGS)

realism: .venv/.dev ## Long campaign outside make test: sensor fits of realistic arms, good and bad (ARGS="--seeds 1 5 --full")
	$(BIN)/python tests/campaigns/realism.py $(ARGS)

walk: .venv/.dev ## Long campaign outside make test: every command of first-run, sweeps, … in order, in real time, on a short arm
	$(BIN)/python tests/campaigns/docs_walk.py $(ARGS)

blind: .venv/.dev ## Long campaign outside make test: the diagnosis against sealed cases (ARGS="--cases 20")
	$(BIN)/armlink gap bench $(ARGS)

batched: .venv/.dev ## Long campaign outside make test: the exported model in MuJoCo and MuJoCo Warp (ARGS="--sim M --train R --heldout R")
	$(BIN)/python tests/campaigns/batched_replay.py $(ARGS)

corruptions: .venv/.dev ## Long campaign outside make test: wrong columns, units and clocks in real recordings (ARGS="--draws 200")
	$(BIN)/python tests/campaigns/corrupted_recordings.py $(ARGS)

sound: .venv/.dev ## Long campaign outside make test: drawn recordings of sound arms, which the check must leave alone (ARGS="--draws 300 --seed 2")
	$(BIN)/python tests/campaigns/sound_recordings.py $(ARGS)

servopeer: .venv/.dev ## Long campaign outside make test: positions alone, beside mujoco.sysid (ARGS="--sim M --train R --heldout R")
	$(BIN)/python tests/campaigns/servo_peer.py $(ARGS)

repeats: .venv/.dev ## Long campaign outside make test: positions alone, bands of motion and two recordings of one arm (ARGS="--arms 4", "--sim M --recordings R … --parts 5 --others 1")
	$(BIN)/python tests/campaigns/servo_repeats.py $(ARGS)

published: .venv/.dev ## Long campaign outside make test: published arm models through new, doctor and demo (ARGS="--only panda ur5 --out table.md")
	test -d .published || $(BIN)/python -m pip install -q --no-deps --target .published example-robot-data rtb-data openarm-mujoco gym-aloha
	$(BIN)/python tests/campaigns/published_models.py .published $(ARGS)

elsewhere: .venv/.dev ## Long campaign outside make test: arms that MuJoCo simulates, with drawn models, rates and noise (ARGS="--cases 24 --seed 1 --rate 30 --torques --models FOLDER")
	$(BIN)/python tests/campaigns/simulated_elsewhere.py $(ARGS)

bodies: .venv/.dev ## Long campaign outside make test: turned bases, bodies added and missing (ARGS="--tilts 40 --bodies 40")
	$(BIN)/python tests/campaigns/gap_tilts_and_bodies.py $(ARGS)

hands: .venv/.dev ## Long campaign outside make test: a hand that the model of a published arm lacks, or has too much (ARGS="--arms 60 --seed 2")
	$(BIN)/python tests/campaigns/gap_hands.py $(ARGS)

again: .venv/.dev ## Long campaign outside make test: a second diagnosis from the model that the first one wrote (ARGS="--only panda")
	$(BIN)/python tests/campaigns/gap_again.py $(ARGS)

laws: .venv/.dev ## Long campaign outside make test: breakaway, warm-up, hum and resonance in the diagnosis (ARGS="--cases 5 --only hum")
	$(BIN)/python tests/campaigns/gap_laws_and_bands.py $(ARGS)

motortorque: .venv/.dev ## Long campaign outside make test: the diagnosis of drawn arms from motor torque alone (ARGS="--arms 10 --zeros 0.03")
	$(BIN)/python tests/campaigns/gap_motor_torque.py $(ARGS)

fleetdays: .venv/.dev ## Long campaign outside make test: a fleet over sixty days, five arms of which wear (ARGS="--arms 8 --days 24")
	$(BIN)/python tests/campaigns/fleet_days.py $(ARGS)

mutants: .venv/.dev ## Long campaign outside make test: changes of the source must make a test fail (MODULES="sim_gap/*/*.py" ARGS="--draw 50")
	$(BIN)/python tests/campaigns/mutants.py $(if $(MODULES),--modules $(foreach each,$(MODULES),'$(each)')) $(ARGS)

mutantdraw: .venv/.dev ## Long campaign outside make test: 500 mutants drawn over the packages; its journal adds runs up (ARGS="--limit 50")
	$(BIN)/python tests/campaigns/mutant_draw.py $(ARGS)

wheel: .venv/.dev ## Build the wheel into dist/ and run the demo from it in an empty environment (ARGS="python3.12 python3.13")
	scripts/test-wheel $(ARGS)

container: ## Build packaging/Containerfile on Debian's packages and run the daemon in it, as root (BASE=docker.io/library/python:3.12-slim)
	scripts/test-container

firsthour: .venv/.dev ## Long campaign outside make test: docs/first-hour.md typed for five models, each to a finished demo report
	$(BIN)/python tests/campaigns/first_hour.py $(ARGS)

pictures: .venv/.dev ## Take the pictures of the daemon's page for the documentation, in Chromium, into docs/images
	$(BIN)/python tests/campaigns/pictures.py $(ARGS)

docs: .venv/.dev ## Build the documentation site into site/ and check it: warnings are errors, links hold, commands run
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	$(BIN)/python -m pytest -q tests/house/test_docs.py

constraints: .venv/.dev ## Write constraints.txt anew from what .venv holds
	@sed -n '/^#/p' constraints.txt > constraints.new
	@$(BIN)/python -m pip freeze --exclude-editable | grep -E '^[A-Za-z0-9._-]+==' >> constraints.new
	@mv constraints.new constraints.txt

lock: .venv/.dev ## Write requirements.lock and requirements-dev.lock anew: exact versions with the hashes of their files
	scripts/lock

audit: .venv/.dev ## Look the locked dependencies up in the database of known vulnerabilities (needs the network)
	@scripts/audit

sbom: .venv/.dev ## Write armlink.cdx.json: the locked dependencies as a bill of materials (CycloneDX)
	$(BIN)/python -m cyclonedx_py requirements requirements.lock --pyproject pyproject.toml --output-reproducible -o armlink.cdx.json

clean: ## Remove what was made, .venv included
	rm -rf .venv .venv.log armlink-demo site .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
