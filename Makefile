# Two commands do all on a machine with Python >= 3.11:  make demo   and   make test
# Everything lives in .venv beside this file; nothing is installed elsewhere.

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: help setup demo quick test nightly durations check mutants bench faults serving fuzz docs site fmt proto bundle build wheel readers release clean sbom audit debian chaos

VENV := .venv
BIN := $(VENV)/bin
# Tried in this order; `make PYTHON=python3.12 demo` names one.
PYTHONS := $(or $(PYTHON),python3 python3.13 python3.12 python3.11)
TORCH := torch==2.13.0
BASELINE := tests/golden/palpate-v1.binpb
# One worker more than cores, four at most: many tests wait for a process or for time to pass. A file
# stays on one worker, so that its fixtures are made once. Numerical libraries would start threads
# for every core in every worker. OMP_THREAD_LIMIT is no way to stop them: scikit-learn then merges
# the neighbours that threads found which never ran. Thousands of processes start; where the
# environment asks for no bytecode, each would compile all of palpate anew.
# MALLOC: large arrays are kept for the next ones, instead of being cleared page by page each time.
WORKERS := $(shell echo $$(($$(getconf _NPROCESSORS_ONLN) < 3 ? $$(getconf _NPROCESSORS_ONLN) + 1 : 4)))
PARALLEL := -n $(WORKERS) --dist loadfile --no-loadscope-reorder
FOR_TESTS := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= \
             MALLOC_MMAP_THRESHOLD_=268435456 MALLOC_TRIM_THRESHOLD_=268435456
pytest_parallel = $(FOR_TESTS) $(BIN)/pytest $(PARALLEL)

help:  ## this list
	@echo "palpate: make <target>"
	@awk -F ':.*## | [|] ' '/^[a-z]+:.*## / {printf "  %-7s %-66s %s\n", $$1, $$2, $$3}' $(firstword $(MAKEFILE_LIST))

setup: $(VENV)/.dev  ## make the full environment in .venv, with torch and tools | 3-8 min, once
	@echo "palpate: ready; try: make demo"

demo: $(VENV)/.demo  ## virtual finger -> features -> recorder: live table and pictures | 30 s after a first install of 1-3 min
	@$(BIN)/palpate demo

quick: $(VENV)/.dev  ## for every save: lint, borders and most tests; types once checked before | 1-2 min
	@if [ -d .mypy_cache ]; then $(BIN)/mypy; \
	else echo "palpate: types are left out: make check fills mypy's cache, later runs use it"; fi
	@$(pytest_parallel) --tier quick

# Hundreds of tests start processes and wait for them, and a busy machine fails one in some thousand.
# What is broken fails alone, too. Anything but failed tests (status 1) is an end at once.
define run_tests
@status=0; $(pytest_parallel) $(1) || status=$$?; \
	if [ $$status -eq 1 ]; then \
		echo "palpate: what has failed is run once more, alone; what passes now is worth a look: it cannot stand a busy machine"; \
		status=0; $(FOR_TESTS) $(BIN)/pytest --last-failed --last-failed-no-failures none || status=$$?; \
	fi; exit $$status
endef

test: $(VENV)/.dev  ## tests of every file, the gates of `check` among them; what CI runs | 6-10 min on two cores after setup
	$(call run_tests,--tier test)

nightly: $(VENV)/.dev  ## all tests: each night, before a release, after a change that reaches far | 30-55 min on two cores
	$(call run_tests,)

durations: $(VENV)/.dev  ## all tests, or FILES="tests/..."; measure anew what `quick` and `test` leave out | 30-55 min on two cores
	@$(pytest_parallel) --record-durations $(FILES)

# The gates are written here and nowhere else: tests/house/test_style.py reads and runs these lines.
check: $(VENV)/.dev  ## format, lint, types, borders, wire contract, house tests | 1-2 min
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/buf lint
	$(BIN)/buf format --diff --exit-code
	$(BIN)/buf breaking --against $(BASELINE)
	$(BIN)/pytest tests/house --ignore=tests/house/test_style.py

# Those of GPUs need one, and are named by their page, docs/results/fem-batched.md.
bench: $(VENV)/.dev  ## latency and throughput beside their bare floor | 2-5 min
	$(BIN)/palpate bench e2e
	@for bench in codec delivery factor; do $(BIN)/python tests/benchmarks/bench_$$bench.py; done

# Each writes its result; the page says which goal is missed, and so does the exit status.
serving_bench = mkdir -p docs/results/serving && $(BIN)/palpate bench

faults: $(VENV)/.dev  ## break what a station stands on, one after another: what do others notice? | 15 min, Linux only
	@failed=0; \
	$(serving_bench) faults --out docs/results/serving/faults.json || failed=1; \
	$(serving_bench) restart --times $(or $(TIMES),3) --out docs/results/serving/restart.json || failed=1; \
	$(serving_bench) restart --times $(or $(TIMES),3) --only fem --only metrics --out docs/results/serving/restart-more.json || failed=1; \
	$(serving_bench) swap --out docs/results/serving/swap.json || failed=1; \
	$(BIN)/python docs/make_serving.py; exit $$failed

serving: $(VENV)/.dev  ## all figures of docs/results/serving.md, on an idle machine | 2 h, Linux only
	@failed=0; \
	$(serving_bench) e2e --runs 5 --out docs/results/serving/e2e.json || failed=1; \
	$(serving_bench) status --count 200 --out docs/results/serving/status.json || failed=1; \
	$(MAKE) faults TIMES=20 || failed=1; \
	$(serving_bench) soak --minutes 30 --out docs/results/serving/soak.json || failed=1; \
	$(BIN)/python docs/make_serving.py; exit $$failed

fuzz: $(VENV)/.dev  ## fuzz the gateway's decoders: make fuzz DECODER=kms40 SECONDS=600 | 10 min each, Linux only
	@$(pip_install) -e '.[fuzz]' | $(show)
	$(BIN)/python -m tests.fuzz.run $(or $(DECODER),all) --seconds $(or $(SECONDS),600)

debian: $(VENV)/.dev  ## install on a bare Debian, run a robot, uninstall: what is left? | 10 min, as root, Linux only
	$(BIN)/python -m tests.install.debian
	$(BIN)/python docs/make_install.py

chaos: $(VENV)/.dev  ## an installed station while one thing after another breaks: MINUTES=30 SEED=1 | 35 min, as root, Linux only
	@failed=0; \
	$(BIN)/python -m tests.chaos.run --minutes $(or $(MINUTES),30) --seed $(or $(SEED),1) || failed=1; \
	$(BIN)/python docs/make_chaos.py; exit $$failed

mutants: $(VENV)/.dev  ## plant small faults in the central modules: which do the tests notice? | 1 h, Linux only
	@$(pip_install) -e '.[mutants]' | $(show)
	$(BIN)/python -m tests.mutation.run $(MODULES)
	$(BIN)/python -m tests.mutation.page

# docs/make_field_picture.py draws docs/pictures/field.png of the README; run it when field-twin is trained anew.
docs: $(VENV)/.dev  ## regenerate generated pages and pictures, check all links | 20 s
	$(BIN)/python docs/make_messages.py
	$(BIN)/python docs/make_asyncapi.py
	$(BIN)/python docs/make_electrode_map.py
	$(BIN)/python docs/make_fingertip_mesh.py
	$(BIN)/python docs/make_indenters.py
	$(BIN)/python docs/make_failures.py
	$(BIN)/python docs/make_house.py
	$(BIN)/python docs/make_install.py
	$(BIN)/python docs/make_models.py
	$(BIN)/python docs/make_study.py
	$(BIN)/python docs/make_numbers.py
	$(BIN)/towncrier build --draft >/dev/null
	$(BIN)/pytest -q tests/house/test_docs.py

site: $(VENV)/.dev  ## the documentation site, into build/site; every warning and dead link is an error | 40 s
	$(BIN)/sphinx-build -q -W --keep-going -b html -c docs/site . build/site
	@echo "palpate: open build/site/index.html"

fmt: $(VENV)/.dev  ## format Python and .proto files, repair what lint can | 5 s
	$(BIN)/ruff check --fix-only --quiet
	$(BIN)/ruff format
	$(BIN)/buf format --write

proto: $(VENV)/.dev  ## regenerate the Python of the .proto files and their page | 5 s
	$(BIN)/python -m grpc_tools.protoc -Iprotos --python_out=protos --pyi_out=protos protos/palpate/v1/*.proto
	$(BIN)/python docs/make_messages.py
	$(BIN)/python docs/make_asyncapi.py

bundle: $(VENV)/.dev  ## train the shipped bundle again, on the virtual finger | 1-5 min
	$(BIN)/palpate bundle virtual

sbom: $(VENV)/.dev  ## every package of .venv with version and licence, as CycloneDX: dist/palpate.cdx.json | 10 s
	@mkdir -p dist
	$(BIN)/cyclonedx-py environment $(BIN)/python --pyproject pyproject.toml --mc-type application \
	    --output-reproducible --of JSON --output-file dist/palpate.cdx.json

# --strict: a package that could not be looked up is a failure, not a pass.
audit: $(VENV)/.dev  ## known vulnerabilities of these packages; asks pypi.org, which must be reachable | 1-2 min
	@$(pip_install) -e '.[audit]' | $(show)
	$(BIN)/pip-audit --strict --skip-editable --progress-spinner off --path $(wildcard $(VENV)/lib/python3*/site-packages)

build: $(VENV)/.dev  ## wheel and source archive, into dist/; the same bytes from the same tree | 10 s
	rm -rf dist
	@$(BIN)/python -m hatchling build -d dist

wheel: build  ## try wheel and source archive in fresh environments: make wheel ON="python3.11 python3.13" | 2 min each
	$(BIN)/python -m tests.install.wheel $(ON)

readers: build  ## play five readers: paste what their pages say, take the time: make readers ONLY="lab robot" | 30 min, Linux only
	$(BIN)/python -m tests.readers.run $(ONLY)
	$(BIN)/python docs/make_readers.py
	$(BIN)/python docs/make_numbers.py

release: $(VENV)/.dev  ## version, changelog and files of a release: make release VERSION=1.2.0 | 20 s
	@[[ "$(VERSION)" =~ ^[0-9]+\.[0-9]+\.[0-9]+$$ ]] || { echo "say which: make release VERSION=1.2.0"; exit 2; }
	sed -i 's/^version = ".*"/version = "$(VERSION)"/' pyproject.toml
	sed -i 's/^version: .*/version: $(VERSION)/' CITATION.cff
	sed -i 's/palpate:[0-9][0-9.]*[0-9]/palpate:$(VERSION)/' deploy/containers/* docs/install.md
	$(BIN)/towncrier build --yes --version $(VERSION)
	sed -i 's#](\.\./\.\./#](#g; s#](\.\./#](docs/#g' CHANGELOG.md  # fragments lie two folders deeper
	@$(MAKE) build

clean:  ## remove caches and built files; keep .venv and recordings | 1 s
	rm -rf build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +

# --- the environment ---------------------------------------------------------------------------
# A stamp is touched after its install succeeded, so an interrupted one is simply done again; it
# depends on pyproject.toml, so changed dependencies are installed by the next command.

# One line per package instead of pip's own output; pip's errors still come through.
show := awk '/^(Collecting|Processing) / { n = split($$2, part, "/"); name = part[n]; \
                 sub(/[^A-Za-z0-9_.-].*|-[0-9].*/, "", name); printf "  %s\n", name; fflush() } \
             /^Installing collected/ { print "  unpacking ..."; fflush() }'
pip_install = $(BIN)/python -m pip install --disable-pip-version-check --progress-bar off

$(VENV)/.made:
	@if $(BIN)/python -c 'import sys, pip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	    touch $@; exit 0; \
	fi; \
	without_venv=; \
	for python in $(PYTHONS); do \
	    "$$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || continue; \
	    if ! "$$python" -c 'import ensurepip, venv' 2>/dev/null; then \
	        without_venv="$$python"; continue; \
	    fi; \
	    echo "palpate: making $(VENV) with $$("$$python" --version)"; \
	    "$$python" -m venv --clear $(VENV); touch $@; exit 0; \
	done; \
	if [ -n "$$without_venv" ]; then \
	    version="$$("$$without_venv" -c 'import sys; print("%d.%d" % sys.version_info[:2])')"; \
	    echo "palpate: $$without_venv cannot make a virtual environment (ensurepip is missing)" >&2; \
	    echo "  -> Debian, Ubuntu: sudo apt install python$$version-venv ; then run make again" >&2; \
	else \
	    echo "palpate: no Python >= 3.11 found (tried: $(PYTHONS))" >&2; \
	    echo "  -> install one (Debian 12+, Ubuntu 24.04+: sudo apt install python3 python3-venv)," >&2; \
	    echo "     or name yours: make PYTHON=/path/to/python3.12 demo" >&2; \
	fi; \
	exit 1

$(VENV)/.demo: $(VENV)/.made pyproject.toml
	@echo "palpate: installing what the demo needs into $(VENV) (about 250 MB, no torch), 1-3 minutes"
	@$(pip_install) -e '.[gateway,services]' | $(show)
	@touch $@

# torch goes first, alone, and by exact version: `==2.13.0` is also met by the CPU build
# `2.13.0+cpu` where the index offers one. Any looser request takes the newest release instead, and
# on Linux that brings gigabytes of CUDA libraries. tests/house compares this pin with pyproject.toml.
# rfc3987-syntax, which comes with cyclonedx-bom, parses a grammar whenever Ray is imported (through
# jsonschema): 1 to 2 s in each process of a cluster. It checks IRIs, and nothing here has any.
$(VENV)/.dev: $(VENV)/.made pyproject.toml
	@echo "palpate: installing everything into $(VENV) (torch and the developer's tools), 3-8 minutes"
	@$(pip_install) '$(TORCH)' | $(show)
	@$(pip_install) -e '.[all,cluster,dev,docs]' | $(show)
	@$(BIN)/python -m pip uninstall --disable-pip-version-check --yes -qq rfc3987-syntax
	@touch $(VENV)/.demo $@
