# Each target works as the first command on a fresh machine with Python 3.11 or newer. PYTHON=... names another Python.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
FLIGHT := .venv/.flight
READY := .venv/.ready
POLICIES := infotaxis,entrotaxis,dcee,random,infotaxis-variance,entrotaxis-belief,thompson,space-aware-infotaxis,greedy,lookahead,homing
LEARNERS := ppo dqn ddpg
# On the leaderboard, beside the learned ones.
BOARD := homing,infotaxis,entrotaxis,dcee,thompson,space-aware-infotaxis,greedy,lookahead
# With a planner, so that compute times are compared in one run.
LEARNED := infotaxis,ppo,dqn,ddpg
# More flags for what a target runs, such as: make results FLAGS='--scenarios 20'
FLAGS ?=

# Tests that start no processes and take no seconds; what is slow among them is marked so.
UNIT := tests/plume tests/link tests/estimator tests/aircraft tests/sitl tests/scene tests/agent tests/ground tests/plumeward tests/test_house.py tests/test_limits.py

.PHONY: setup hashes chromium clients mission quick test test-all fuzz lint docs site bench bench-filter bench-planners bench-env bench-page train results report mismatch chaos golden clean

# Left behind by an install that did not finish. Then .venv is made anew: pip may take a half-written package for a whole one.
UNFINISHED := .venv/.unfinished
ifneq ($(wildcard $(UNFINISHED)),)
.PHONY: $(FLIGHT)
endif
# pip compiles nothing: Python compiles what is imported, once, and has to be allowed to keep it.
unexport PYTHONDONTWRITEBYTECODE
# Nothing is built but Plumeward itself, and that with the hatchling of requirements.txt, not with the newest.
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile --only-binary :all: --no-build-isolation
INSTALL := $(PIP) -c constraints.txt

setup: $(READY) chromium clients

# Two layers: what a flight needs, and on top of it all the rest. Each is brought up to date when the files that it is made from change.
$(FLIGHT): pyproject.toml constraints.txt requirements.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Plumeward needs Python 3.11 or newer; name one with: make PYTHON=...")'
	@if [ -e $(UNFINISHED) ]; then echo 'the last install did not finish: starting again'; rm -rf .venv; fi
	@echo 'installing what a flight needs into .venv, about 420 MB'
	@mkdir -p .venv && touch $(UNFINISHED)
	@$(PYTHON) -m venv .venv
	@$(PIP) --require-hashes -r requirements.txt
	@$(PIP) --no-deps -e .
	@rm $(UNFINISHED) && touch $@

# particles, a peer of the benchmarks, asks for an older numpy but works with ours.
$(READY): $(FLIGHT)
	@echo 'installing what tests, training and benchmarks need into .venv, about 2 GB'
	@touch $(UNFINISHED)
	@$(INSTALL) -e '.[test]'
	@$(INSTALL) --no-deps particles
	@rm $(UNFINISHED) && touch $@
	@$(BIN)/pytest --collect-only -qq > /dev/null || true # Python compiles once what else each of four processes would

# After a change of pyproject.toml or constraints.txt: what a flight needs, with the hashes of every file that the index has of it.
# Of the Pythons we support the oldest is asked: it needs all that the newer ones need.
hashes:
	python3.11 -m venv build/hashes
	build/hashes/bin/pip install --quiet --disable-pip-version-check pip-tools==7.6.2
	CUSTOM_COMPILE_COMMAND='make hashes' build/hashes/bin/pip-compile --quiet --no-config --generate-hashes --build-deps-for editable \
		--no-annotate --no-emit-options --strip-extras --allow-unsafe -c constraints.txt -o requirements.txt pyproject.toml

chromium:
	@sh tests/view/chromium.sh

# After all of .venv is there: it may be made anew.
clients: $(READY)
	@sh tests/clients/install.sh

mission: $(FLIGHT)
	$(BIN)/plumeward fly $(FLAGS)

quick: lint
	$(BIN)/pytest -n 2 -m 'not full and not slow' $(UNIT) $(FLAGS)

# More processes than a small machine's two cores: missions spend about half of their time waiting. tests/workers.py says which runs what.
test: $(READY) chromium
	$(BIN)/pytest -n 6 -m 'not full' $(FLAGS)

test-all: setup
	$(BIN)/pytest -n 6 -m full $(FLAGS)

# Takes hours; `make fuzz FLAGS='belief --runs 1000'` fuzzes one decoder for less. It needs Linux on x86-64.
fuzz: setup
	$(INSTALL) -e '.[fuzz]'
	$(BIN)/python -m tests.fuzz $(FLAGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: setup
	$(BIN)/python -m docs.generate.bus > docs/bus.md
	$(BIN)/python -m docs.generate.mavlink > docs/mavlink.md
	$(BIN)/python -m docs.generate.schema > missions/mission.schema.json
	$(BIN)/python -m sitl fly --speedup 0 --record runs/mission.mcap --force
	$(BIN)/python -m sitl draw runs/mission.mcap --out docs/mission.svg --force

# Pages for a browser: site/index.html. It needs no network, neither here nor there.
site: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: setup
	$(BIN)/python benchmarks/loop.py $(FLAGS)

bench-filter: setup
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.filter

# The peer is Stone Soup.
bench-planners: setup
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.planners

bench-env: setup
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.env

bench-page: setup
	$(BIN)/python -m benchmarks.page $(FLAGS)

# Trains the shipped policies again. This and the next take long; if interrupted, run the command again: it resumes.
train: setup
	mkdir -p agent/bundles
	for learner in $(LEARNERS); do $(BIN)/python -m agent train $$learner $(FLAGS) && cp runs/train/$$learner-tuned-0/$$learner.zip agent/bundles/ || exit; done

# Flies only the missions that results/ lacks: a file that has all of them stays as it is.
results: setup
	mkdir -p results
	$(BIN)/python -m agent evaluate --assume paper --policy $(POLICIES) --particles 100,500,1000,2000,4000 --missions results/particles.csv.gz --resume $(FLAGS)
	$(BIN)/python -m agent evaluate --assume paper --policy $(POLICIES) --threshold 0.1,0.2,0.3,0.4,0.5,0.6,0.7,0.8,0.9 --missions results/thresholds.csv.gz --resume $(FLAGS)
	$(BIN)/python -m agent evaluate --assume paper --policy $(LEARNED) --particles 100,500,1000,2000,4000 --missions results/learned-particles.csv.gz --resume $(FLAGS)
	$(BIN)/python -m agent evaluate --assume paper --policy $(LEARNED) --threshold 0.1,0.2,0.3,0.4,0.5,0.6,0.7,0.8,0.9 --missions results/learned-thresholds.csv.gz --resume $(FLAGS)
	$(BIN)/python -m agent evaluate --assume paper --policy results/learners/paper-ppo.zip,results/learners/paper-dqn.zip,results/learners/paper-ddpg.zip --missions results/paper-learners.csv.gz --resume $(FLAGS)
	mkdir -p results/leaderboard
	$(BIN)/python -m agent evaluate --policy $(BOARD),ppo,dqn,ddpg --world as-modelled,puffs:share=0.2 --scenarios 100 --missions results/leaderboard/paper.csv.gz --resume $(FLAGS)
	$(BIN)/python -m agent evaluate --policy $(BOARD) --problem missions/wide-field.yaml --scenarios 100 --missions results/leaderboard/wide-field.csv.gz --resume $(FLAGS)

# Tables and pictures of docs/results.md, and the figures of the README, from the rows in results/.
report: setup
	$(BIN)/python -m agent report --force $(FLAGS)
	cp report/results.md report/particles.png report/trajectories.png docs/
	$(BIN)/python -m benchmarks.readme

# Takes hours; if interrupted, run the command again: it resumes.
mismatch: setup
	$(BIN)/python -m benchmarks.trust --resume $(FLAGS)

# Takes long; rows of earlier calls stay. Some faults need namespaces, nft and a C compiler (Debian: iproute2 nftables gcc); without them fewer missions are flown.
chaos: setup
	$(BIN)/python -m benchmarks.chaos $(FLAGS)

# After an intended change of behaviour: shows which golden missions differ, and records them again.
golden: setup
	$(BIN)/python -m tests.golden

clean:
	rm -rf .venv build *.egg-info runs report site
	find . -name __pycache__ -prune -exec rm -rf {} +
