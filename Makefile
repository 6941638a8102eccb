# Every target creates .venv; only Python 3.11 or newer and make must be installed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DEV := $(VENV)/.dev
ARGS = --source sim: --http 127.0.0.1:9464
unexport PYTHONDONTWRITEBYTECODE  # set in some images: each pytest worker would compile all tests again, for 8 s

SECONDS = 600
IMAGE_EXTRAS = mavlink mcap metrics pki web
# The lock files are valid on x86-64 and ARM64 and for every supported Python; they omit the package index's address.
LOCK = -q --upgrade --universal --python-version 3.11 --generate-hashes --no-header --no-emit-index-url

.PHONY: run check api api-baseline generated docs quick test behaviour slow long test-all measured fuzz compose-test wheel lock bench clean

# The shell waits for a service in the background: only then does a trap run at once, when make is killed and kills it.
run: $(READY)  ## run the service with a simulated flight, or with ARGS; it prints a command for a second terminal
	$(info $(BIN)/nedbus serve $(ARGS))
	@$(BIN)/nedbus serve $(ARGS) & service=$$!; trap : INT; trap 'kill $$service' TERM; \
	while wait $$service; code=$$?; kill -0 $$service 2>/dev/null; do :; done; case $$code in \
	130) exit 0 ;; \
	1) echo 'for other options: make run ARGS="--source sim: --vehicle 2 --connect tcp/127.0.0.1:7447"' >&2 ;; \
	esac; exit $$code

check: $(DEV)  ## lint, import rules and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo
	$(BIN)/mypy

api: $(DEV)  ## compare the public API with the last release; `make test` does so, too
	$(BIN)/python -m tests.release.api_baseline

api-baseline: $(DEV)  ## record the public API, as part of a release
	$(BIN)/python -m tests.release.api_baseline --write

generated: $(DEV)  ## generate the page of each message, and vectors of the wire format
	$(BIN)/python -m docs.generator

docs: $(DEV)  ## build the site with its reference in build/site; a broken link is an error
	$(BIN)/pip install -q --group docs
	$(BIN)/python -m docs.generator --site
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet --fresh-env docs build/site
	@! grep -rnE '<(script|link|img)[^>]+(src|href)="https?:' build/site --include='*.html'  # the site loads nothing from other hosts
	@echo "build/site/index.html is the site; to serve it: $(BIN)/python -m http.server --directory build/site"

quick: $(DEV)  ## run the tests without routers or processes: a minute and a half on two idle cores
	$(BIN)/pytest -q -n 2 -m "quick or not (slow or long or router or process or compose)" --junitxml=build/tests.xml

test: check behaviour  ## run `make check` and the tests of behaviour that take less than a second: 150 s on two idle cores

behaviour: $(DEV)
	$(BIN)/pytest -q -n 3 --dist worksteal -m "not (slow or long or compose)" --junitxml=build/tests.xml

slow: $(DEV)  ## run the tests that take longer than a second, and the property tests with three times as many examples
	$(BIN)/pytest -q -n 4 --dist worksteal -m "(slow or hypothesis) and not (long or compose)" --hypothesis-profile=all --junitxml=build/slow-tests.xml

long: $(DEV)  ## run the tests of complete flights, of much damage, and of programs that other compilers build
	$(BIN)/pytest -q -n 4 --dist worksteal -m "long and not compose" --junitxml=build/long-tests.xml

test-all: SECONDS = 60
test-all: check measured fuzz compose-test  ## run everything: with branch coverage, slow tests, a minute of fuzzing, and containers

measured: $(DEV)  ## run the tests of `make test`, `make slow` and `make long` with branch coverage
	$(BIN)/coverage erase
	$(BIN)/coverage run -m pytest -q -n 4 --dist worksteal -m "not compose" --hypothesis-profile=all
	$(BIN)/coverage combine -q
	$(BIN)/coverage report

fuzz: $(DEV)  ## fuzz the parsers for ten minutes, or SECONDS, in total
	$(BIN)/pip install -q --group fuzz
	$(BIN)/python -m fuzz --seconds $(SECONDS)

compose-test: $(DEV)  ## run the container tests; they need Docker with compose
	$(BIN)/pytest -q -n 3 --dist loadfile -o timeout_method=signal -o faulthandler_timeout=590 -m compose --junitxml=build/compose-tests.xml

wheel: $(DEV)  ## build the wheel, install it in a clean environment, use it, and write its SBOM
	$(BIN)/pip install -q --group sbom
	rm -rf dist build/wheel-venv
	$(BIN)/python -m build --wheel
	$(PYTHON) -m venv --without-pip build/wheel-venv
	$(BIN)/pip --python build/wheel-venv install -q "$$(echo dist/nedbus-*.whl)[all]"
	cd build && wheel-venv/bin/python -c "import nedbus, nedbus_msgs" && wheel-venv/bin/nedbus --version
	for extras in "" metrics; do \
	$(PYTHON) -m venv --without-pip --clear build/bare-venv && \
	$(BIN)/pip --python build/bare-venv install -q "$$(echo dist/nedbus-*.whl)$${extras:+[$$extras]}" && \
	(cd build && bare-venv/bin/python ../tests/release/every_command.py $$extras) || exit 1; done
	rm -rf build/pki build/vehicle-1
	cd build && wheel-venv/bin/nedbus pki ca pki && wheel-venv/bin/nedbus pki enroll pki 1 -r tls/127.0.0.1:7447
	PATH=$(abspath $(BIN)):$$PATH packaging/sbom build/wheel-venv "$$(echo dist/nedbus-*.whl | sed 's/-py3.*/.cdx.json/')"
	@! grep -qF '[SECURITY CONTACT' SECURITY.md || echo 'warning: SECURITY.md has no contact; fill it in before a release' >&2

lock: $(DEV)  ## update the pinned dependencies of the image to the newest versions that pyproject.toml allows
	$(BIN)/pip install -q --group lock
	$(BIN)/uv pip compile $(LOCK) $(IMAGE_EXTRAS:%=--extra %) pyproject.toml -o packaging/requirements-image.txt
	$(BIN)/uv pip compile $(LOCK) --group sbom -o packaging/requirements-build.txt

bench: $(DEV)  ## run the benchmarks: comparison with alternatives, fleets, slow readers, replay pacing, idle load, Ctrl-C
	$(BIN)/pip install -q --group bench
	$(BIN)/python -m benchmarks.compare
	$(BIN)/python -m benchmarks.compare.picture
	$(BIN)/python -m benchmarks.scale
	$(BIN)/python -m benchmarks.load
	$(BIN)/python -m benchmarks.record --seconds 60
	$(BIN)/python -m benchmarks.readers.busy
	$(BIN)/python -m benchmarks.readers.stuck
	$(BIN)/python -m benchmarks.events
	$(BIN)/python -m benchmarks.resets
	$(BIN)/python -m benchmarks.pacing
	$(BIN)/python -m benchmarks.idle
	$(BIN)/python -m benchmarks.interrupts --count 10
	$(BIN)/python -m benchmarks.restart
	$(BIN)/python -m benchmarks.soak --names 10000
	$(BIN)/python -m benchmarks.ulog.files
	$(BIN)/python -m benchmarks.ulog.stream
	$(BIN)/python -m benchmarks.ulog.service
	$(BIN)/python -m benchmarks.ulog.memory
	$(BIN)/python -m benchmarks.metrics

$(READY): pyproject.toml  # dependencies of nedbus
	@echo "creating a virtual environment in $(VENV) ..."
	@$(PYTHON) -m venv $(VENV)
	@echo "installing nedbus and its dependencies, about 200 MB ..."
	@$(BIN)/pip install --disable-pip-version-check --editable ".[metrics]"
	@touch $(READY)

$(DEV): $(READY) pyproject.toml  # dependencies of tests, checks and benchmarks
	@echo "installing the development dependencies, about 600 MB ..."
	$(BIN)/python -m pip install -q --upgrade "pip>=25.1"
	$(BIN)/pip install -q --group dev --editable .
	touch $(DEV)

clean:
	rm -rf $(VENV) dist build .coverage* .mypy_cache .ruff_cache .pytest_cache .hypothesis
