# Tasks for users and developers; `make help` lists them.

PYTHON ?= python3
PORT ?= 8000
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help setup demo serve test ray lint openapi docs neighbours site client web clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

setup: $(STAMP) ## create .venv and install everything

$(STAMP): pyproject.toml constraints.txt scripts/setup.sh scripts/install_torch.py
	PYTHON="$(PYTHON)" VENV="$(VENV)" scripts/setup.sh
	@touch $@

demo: $(STAMP) ## localise the example panoramas over HTTP, write demo.png
	$(BIN)/python -m examples.demo

serve: $(STAMP) ## run the service at http://127.0.0.1:8000 (or PORT=...) with the example plan, data in ./data
	$(BIN)/python -m examples.serve --port $(PORT)

# Two processes with one thread each; each takes over tests of the other when it has no more of its own. Browsers need an
# otherwise idle machine, so their tests are last and alone; they run even if others fail.
ALONE := tests/web
test: $(STAMP) ## lint, build the site, run the tests
	$(MAKE) --no-print-directory -j 2 lint site
	@status=0; \
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal $(ALONE:%=--ignore=%) || status=1; \
	$(BIN)/python -m pytest $(ALONE) || status=1; \
	exit $$status

# A new cluster per file, so that files do not share state.
ON_RAY := floorplans localise resources idempotency events venues venue_queries sequence
ray: $(STAMP) ## run the tests of Ray, and the API's tests on Ray (about 20 minutes)
	$(BIN)/python -m pytest -m "slow or not slow" tests/service/test_on_ray.py
	for file in $(ON_RAY); do TEST_DATABASE=ray $(BIN)/python -m pytest tests/service/test_$$file.py || exit 1; done

lint: $(STAMP) ## run ruff and pyright
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

openapi: $(STAMP) ## write openapi.yaml from the application
	$(BIN)/python -m service.openapi openapi.yaml

docs: $(STAMP) ## write the generated parts of docs/
	$(BIN)/python -m scripts.write_docs

neighbours: $(STAMP) ## measure every route beside another tenant, write docs/reference/neighbours.md (about 10 minutes)
	-$(BIN)/python -m benchmarks.neighbours --json docs/neighbours.json
	$(BIN)/python -m scripts.write_docs

site: $(STAMP) ## build the documentation site into build/site; warnings are errors
	$(BIN)/python -m sphinx -q -W --keep-going -j 2 docs build/site

client: $(STAMP) ## generate lalaloc_client/blocking from lalaloc_client/asynchronous
	$(BIN)/python -m scripts.generate_client

web: ## build the web pages from web/ into service/web, and clients/typescript (needs node and npm)
	cd web && npm ci --no-audit --no-fund && npm run types && npm run check && npm run build
	cd clients/typescript && npm run build

clean: ## remove .venv and all build products; keep ./data and ./runs
	rm -rf $(VENV) web/node_modules clients/typescript/node_modules clients/typescript/dist build dist *.egg-info .pytest_cache .ruff_cache .hypothesis demo.png
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
