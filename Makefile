SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

# uv leaves it to Python to compile what is imported, which takes a fraction of the time for all files.
unexport PYTHONDONTWRITEBYTECODE

BIN := .venv/bin
READY := .venv/.ready
KERNELS := .venv/.kernels
# Two test processes share two cores: one thread each.
ONE_THREAD := OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 TF_NUM_INTRAOP_THREADS=1 TF_NUM_INTEROP_THREADS=1
CORE := $(patsubst %,tests/test_%.py,arrays cli coverage features files house link_model map_files measurements metrics \
	network outlines partial_map predictor ros_map scene settings slab trace unobserved)
DATASET = $(BIN)/sionna-partial dataset build/predictor
LEARNED_FROM := build/predictor/{camera,mixed,lidar,large,large_lidar,floors,floors_lidar}
STAGES := --stage 0 --stage 0.3 --stage 0.6 --stage 0.9 --stage 1 --links 120
FLOORS := --kind floor --short-links 0.5
LARGE := --kind hall --kind warehouse $(FLOORS)

CHECKSUMS := cd sionna_partial/predictors && sha256sum *.json *.keras *.npz > SHA256SUMS

.PHONY: help demo test check core kernels kernels-plan kernels-mesh kernels-beams kernels-paths suite docs site pages hostile lint format lock scenes predictor wheel wheel-check clean

help: ## List what can be made
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 24

demo: $(KERNELS) ## Predict a half-explored demo home, and compare with the truth (demo-output/)
	@$(BIN)/sionna-partial demo --out demo-output

test: kernels ## Check style and types, and run the tests (PAGES=1: and all pages; builds the site)
	@$(MAKE) --no-print-directory -j 2 suite $(if $(PAGES),site)

kernels: $(READY)
	@$(MAKE) --no-print-directory -j 3 kernels-plan kernels-mesh lint

suite: $(READY)
	@$(ONE_THREAD) MPLBACKEND=Agg $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(if $(PAGES),-m 'not slow')

check: $(READY) ## Check style and types, and run the tests of the core, in two minutes
	@$(MAKE) --no-print-directory -j 2 core lint

core: $(READY)
	@$(ONE_THREAD) MPLBACKEND=Agg $(BIN)/python -m pytest -q $(CORE)

kernels-plan kernels-mesh kernels-beams kernels-paths: kernels-%: $(READY)
	@$(ONE_THREAD) $(if $(filter mesh,$*),nice) $(BIN)/python tests/compile_kernels.py $*

docs: $(READY) ## Build the site, with its pages, notebooks and examples run (build/docs/index.html)
	@$(MAKE) --no-print-directory -j 2 site pages
	@echo "the site is build/docs/index.html"

site: $(READY)
	@$(ONE_THREAD) $(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going -c docs -d build/doctrees . build/docs

pages: $(READY)
	@$(ONE_THREAD) $(BIN)/python -m pytest -q -m pages tests/test_readme.py

hostile: $(READY) ## Run hostile inputs for an hour, each with limits of time and memory
	@mkdir -p build
	@$(ONE_THREAD) $(BIN)/python tests/hostile/attack.py --minutes 60 --table build/hostile.md

lint: $(READY) ## Check style and types
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@nice $(BIN)/mypy

format: $(READY) ## Format the code
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

lock: $(READY) ## Lock the newest allowed dependencies from PyPI in requirements.lock
	@env -u PIP_FIND_LINKS -u PIP_EXTRA_INDEX_URL PIP_CONFIG_FILE=/dev/null CUSTOM_COMPILE_COMMAND="make lock" \
		$(BIN)/pip-compile --upgrade --extra dev --extra all --generate-hashes --allow-unsafe --strip-extras --quiet \
		--constraint constraints.txt --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --output-file requirements.lock pyproject.toml

scenes: $(READY) ## Make the demo scenes again (scenes/)
	@$(BIN)/python scenes/make_scenes.py

predictor: $(READY) ## Train predictors like the shipped ones, and put them there (sionna_partial/predictors/)
	@rm -rf build/predictor
	@$(DATASET)/camera --homes 300 --first-seed 330000 --links 160
	@$(DATASET)/mixed --homes 154 --first-seed 320000 --mixed-sensors $(STAGES)
	@$(DATASET)/lidar --homes 30 --first-seed 340000 --field-of-view 360 --range 12 $(STAGES)
	@$(DATASET)/large --homes 54 --first-seed 350000 --mixed-sensors $(STAGES) $(LARGE)
	@$(DATASET)/large_lidar --homes 65 --first-seed 360000 --field-of-view 360 --range 20 $(STAGES) $(LARGE)
	@$(DATASET)/floors --homes 36 --first-seed 371000 --mixed-sensors $(STAGES) $(FLOORS)
	@$(DATASET)/floors_lidar --homes 50 --first-seed 370000 --field-of-view 360 --range 12 $(STAGES) $(FLOORS)
	@for networks in paper map; do \
		TF_ENABLE_ONEDNN_OPTS=1 $(BIN)/sionna-partial train $(LEARNED_FROM) \
			--networks $$networks --passes 13 --test-fraction 0.1 --out build/predictor/$$networks; \
		for suffix in keras json; do \
			cp build/predictor/$$networks/predictor.$$suffix sionna_partial/predictors/$$networks.$$suffix; done; done
	@cp build/predictor/map/distance.* build/predictor/map/majority.json sionna_partial/predictors/
	@$(CHECKSUMS)
	@$(BIN)/python -m sionna_partial.lab.training.paths sionna_partial/predictors/paths.npz
	@$(BIN)/python -m sionna_partial.lab.training.walls sionna_partial/predictors/unseen_walls.npz
	@$(CHECKSUMS)
	@$(BIN)/sionna-partial evaluate $(LEARNED_FROM) --out build/predictor/report > /dev/null
	@echo "the report is in build/predictor/report/, the predictors are in sionna_partial/predictors/"

wheel: $(READY) ## Build the source archive, and the wheel from it (dist/)
	@$(BIN)/python -m build --no-isolation

wheel-check: $(READY) ## Install source archive and wheel in a new environment, and run the demo there
	@$(BIN)/python -m pytest -m 'slow or pages' tests/test_wheel.py

clean: ## Remove what was made, the environment too
	@rm -rf .venv build dist demo-output .pytest_cache .hypothesis .mypy_cache .ruff_cache
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(READY): requirements.lock pyproject.toml install_locked.py
	@python=; for name in python3.11 python3.12 python3.13 python3; do \
		if "$$name" -c 'import sys, ensurepip, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; \
		then python=$$name; break; fi; done; \
	if [ -z "$$python" ]; then \
		echo "error: no Python 3.11, 3.12 or 3.13 with venv was found: install python3.11 (Debian: python3.11-venv too)." >&2; \
		exit 2; fi; \
	echo "setting up .venv with $$("$$python" --version) (a minute, 3 GB)"; \
	"$$python" -m venv --clear .venv
	@$(BIN)/python install_locked.py
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

$(KERNELS): $(READY)
	@echo "compiling, once (half a minute)"
	@$(MAKE) --no-print-directory -j 2 kernels-beams kernels-paths
	@touch $@
