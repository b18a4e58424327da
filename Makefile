# Tasks for users and developers; `make help` lists them.

# Bytecode is kept, even where the environment says otherwise: every test that starts a process would compile it again.
unexport PYTHONDONTWRITEBYTECODE

PYTHON ?= python3
PORT ?= 8000
VENV := .venv
BIN := $(VENV)/bin
# Stamps of the environment: with what serving needs, and with everything.
SERVING := $(VENV)/.serving
STAMP := $(VENV)/.everything
comma := ,

.DEFAULT_GOAL := help
.PHONY: help setup develop demo serve serve-lan check test test-all ray lint types openapi docs neighbours pictures site client web lock notice audit digests clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

setup: $(SERVING) ## create .venv and install what serving and the command line need

$(SERVING): pyproject.toml serving.lock scripts/setup.sh scripts/install_lock.py
	@PYTHON="$(PYTHON)" VENV="$(VENV)" scripts/setup.sh serving
	@touch $@

develop: $(STAMP) ## install the rest as well: training, tests, documentation

$(STAMP): pyproject.toml requirements.lock torch.lock scripts/setup.sh scripts/install_lock.py scripts/install_torch.py
	@PYTHON="$(PYTHON)" VENV="$(VENV)" scripts/setup.sh everything
	@touch $@ $(SERVING)

demo: $(SERVING) ## localise the example photographs over HTTP, write demo.png
	@$(BIN)/python -m examples.demo

# Answers are kept for a day, so that links to them can be shared; photographs never are. The shell becomes the service, so
# that signals reach it.
define serve
@LALALOC_KEEP_ANSWERS_S=$${LALALOC_KEEP_ANSWERS_S:-86400} LALALOC_LOG_LEVEL=$${LALALOC_LOG_LEVEL:-warning} \
	exec $(BIN)/lalaloc-service serve --example --port $(PORT) $(1)
endef

serve: $(SERVING) ## run the service at http://127.0.0.1:8000 (or PORT=...) with the example plan, data in ./data
	$(call serve)

serve-lan: $(SERVING) ## the same for phones in this network: with TLS, and a link with an API key
	$(call serve,--lan)

# Three processes with one thread each keep two cores busy, as many tests wait; each takes whole files, whose tests share
# services. Browsers keep a core busy each, so their tests are last, two at a time; they run even if others fail.
ALONE := tests/web
PYTEST := $(BIN)/python -m pytest
define run_tests
@status=0; \
	OMP_NUM_THREADS=1 $(PYTEST) -n 3 --dist loadfile $(ALONE:%=--ignore=%) $(1) || status=1; \
	$(PYTEST) -n 2 --dist loadfile $(ALONE) $(1) || status=1; \
	exit $$status
endef

test: $(STAMP) ## run the tests (about 7 minutes on two cores)
	$(call run_tests)

# Shapes and types in the core's signatures are checked whenever tests call it.
test-all: $(STAMP) ## run all tests, those of a release as well, and check types while they run (before a release)
	$(call run_tests,-m "slow or not slow" --jaxtyping-packages=lalaloc_core$(comma)beartype.beartype)

# A new cluster per file, so that files do not share state.
ON_RAY := floorplans localise resources idempotency events venues venue_queries sequence albums
ray: $(STAMP) ## run the tests of Ray, and the API's tests on Ray (about 20 minutes)
	$(PYTEST) -m "slow or not slow" tests/service/test_on_ray.py
	for file in $(ON_RAY); do TEST_DATABASE=ray $(PYTEST) tests/service/test_$$file.py || exit 1; done

check: $(STAMP) ## lint, check types, build the documentation site, warn of slower stages
	@$(MAKE) --no-print-directory -j 2 types lint site
	-@$(BIN)/python -m benchmarks.pairs

PRETTIER := web/node_modules/.bin/prettier
lint: $(STAMP) ## run ruff and, after `npm ci` in web/, prettier
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	@if [ -x $(PRETTIER) ]; then npm --prefix web run --silent format:check; \
		else echo 'lint: prettier is not installed, so TypeScript is not checked: run `npm ci` in web/' >&2; fi

types: $(STAMP) ## run pyright
	$(BIN)/pyright

openapi: $(STAMP) ## write openapi.yaml from the application
	$(BIN)/python -m service.openapi openapi.yaml

docs: $(STAMP) ## write the generated parts of docs/
	$(BIN)/python -m scripts.write_docs

neighbours: $(STAMP) ## measure every route beside another tenant, write docs/reference/neighbours.md (about 15 minutes)
	-$(BIN)/python -m benchmarks.neighbours --json docs/neighbours.json
	$(BIN)/python -m scripts.write_docs

pictures: $(STAMP) ## draw the pictures of README.md and docs/ into docs/images (needs Chromium; about 2 minutes)
	$(BIN)/python -m scripts.draw_pictures

site: $(STAMP) ## build the documentation site into build/site; warnings are errors
	$(BIN)/python -m sphinx -q -W --keep-going -j 2 docs build/site

client: $(STAMP) ## generate lalaloc_client/blocking from lalaloc_client/asynchronous
	$(BIN)/python -m scripts.generate_client

web: ## build the web pages from web/ into service/web, and clients/typescript (needs node and npm)
	cd web && npm ci --no-audit --no-fund && npm run types && npm run check && npm run build
	cd clients/typescript && npm run build

# Beside the environment, so that it stays as small as its users need it.
build/tools/bin/pip-audit:
	$(BIN)/python -m venv build/tools
	build/tools/bin/python -m pip install --quiet pip-audit==2.10.1

lock: $(STAMP) ## write serving.lock, requirements.lock and docker/requirements.lock from constraints.txt
	$(BIN)/python -m scripts.write_locks $(BIN)/uv

notice: $(STAMP) ## write the licences of all that ships into NOTICE
	$(BIN)/python -m scripts.write_notice

audit: $(STAMP) build/tools/bin/pip-audit ## look for known vulnerabilities of Python and npm packages (needs the network)
	build/tools/bin/pip-audit --strict --disable-pip --no-deps -r requirements.lock -r docker/requirements.lock
	npm --prefix web audit --audit-level=moderate
	npm --prefix clients/typescript audit --audit-level=moderate

digests: ## write the digests of the base images into docker/images.env (needs docker buildx and the registry)
	@(while IFS='=' read -r name image; do case "$$name" in \
		''|'#'*) printf '%s%s\n' "$$name" "$${image:+=$$image}" ;; \
		*) tag=$${image%@*}; digest=$$(docker buildx imagetools inspect "$$tag" --format '{{.Manifest.Digest}}') || exit 1; \
			printf '%s=%s@%s\n' "$$name" "$$tag" "$$digest" ;; \
	esac; done) <docker/images.env >docker/images.env.part || { rm -f docker/images.env.part; exit 1; }
	@mv docker/images.env.part docker/images.env

clean: ## remove .venv and all build products; keep ./data and ./runs
	rm -rf $(VENV) web/node_modules clients/typescript/node_modules clients/typescript/dist build dist *.egg-info .pytest_cache .ruff_cache .hypothesis demo.png
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
