.POSIX:
.PHONY: help demo test test-slow test-recordings test-oracles agreement proof concealed benchmarks measured gallery lock clean

VENV = .venv
LOCK = requirements.lock
PYTHON = $(VENV)/bin/python
PIP = $(PYTHON) -m pip --disable-pip-version-check --quiet
OPTIONS =

help: ## print this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-16s %s\n", $$1, $$2 }' Makefile

demo: $(VENV)/project.stamp ## diagnose the recording that ships inside the package
	@$(VENV)/bin/symplearn demo

test: $(VENV)/project.stamp ## linter, formatter, types, and every test of seconds
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/pytest -m "not slow" -n 2 --dist loadfile --durations=30

test-slow: $(VENV)/project.stamp ## the tests of minutes
	$(VENV)/bin/pytest -m slow

test-recordings: $(VENV)/project.stamp ## the tests on real recordings, which fail where the recordings are absent
	SYMPLEARN_REQUIRE_RECORDINGS=1 $(VENV)/bin/pytest -m recordings

test-oracles: ## agreement with other packages, in an environment of its own (.venv-oracles, 1.3 GB)
	@$(MAKE) -s VENV=.venv-oracles LOCK=requirements-oracles.lock agreement

agreement: $(VENV)/project.stamp
	$(VENV)/bin/pytest tests/oracles

proof: ## diagnose 120 concealed cases beside today's practice (hours; it goes on where it was stopped; OPTIONS=--quick)
	@$(MAKE) -s VENV=.venv-oracles LOCK=requirements-oracles.lock concealed

concealed: $(VENV)/project.stamp
	$(VENV)/bin/python -m experiments.concealed $(OPTIONS)

benchmarks: ## speed and memory beside other packages, in .venv-oracles (an hour; OPTIONS="--quick cherry"; see BENCHMARKS.md)
	@$(MAKE) -s VENV=.venv-oracles LOCK=requirements-oracles.lock measured

measured: $(VENV)/project.stamp
	$(VENV)/bin/python -m benchmarks $(OPTIONS)

gallery: $(VENV)/project.stamp ## the pages of docs/gallery, from the real recordings; a run that was stopped goes on
	$(PYTHON) -m experiments.gallery

# Two stamps: a new lock makes the environment anew, a new pyproject.toml only installs the project again.
# A stamp is the last thing written, so an interrupted run starts over. What is edited in place is compiled here, as pip
# does with everything else: where Python is told to write no bytecode, every start would compile it all again.
$(VENV)/lock.stamp: $(LOCK)
	@python=; for candidate in python3.12 python3.11 python3 python3.13; do \
	    if "$$candidate" -c '$(USABLE)' >/dev/null 2>&1; then python=$$candidate; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	    echo "symplearn needs Python 3.11 or newer with its venv module (on Debian: python3-venv) as" \
	        "python3.12, python3.11 or python3 on the PATH." >&2; \
	    exit 1; \
	fi; \
	echo "Making $(VENV) with $$("$$python" --version) from $(LOCK): once, a few minutes."; \
	"$$python" -m venv --clear $(VENV)
	@$(PIP) install --only-binary :all: --require-hashes -r $(LOCK)
	@touch $@

USABLE = import ensurepip, sys, venv; sys.exit(sys.version_info < (3, 11))

$(VENV)/project.stamp: $(VENV)/lock.stamp pyproject.toml
	@$(PIP) install --no-deps --no-build-isolation --editable .
	@$(PYTHON) -m compileall -q integrators symplearn
	@$(PIP) check
	@touch $@

# Resolved by Python 3.11, the oldest we support, from the public index alone whatever pip is configured to here.
# Keeps the versions already pinned; `make lock OPTIONS=--upgrade` takes the newest. Where the two locks overlap they
# agree: the second is resolved under the first.
lock: ## pin what pyproject.toml asks for: names, versions, hashes
	@rm -rf .venv-lock && python3.11 -m venv .venv-lock
	@.venv-lock/bin/python -m pip --disable-pip-version-check --quiet install 'pip-tools>=7.5'
	@.venv-lock/bin/python -c '$(REQUIREMENTS)' dev > .venv-lock/requirements.in
	@.venv-lock/bin/python -c '$(REQUIREMENTS)' dev oracles > .venv-lock/requirements-oracles.in
	@$(COMPILE) --output-file requirements.lock .venv-lock/requirements.in
	@$(COMPILE) --constraint requirements.lock --output-file requirements-oracles.lock \
	    .venv-lock/requirements-oracles.in
	@rm -rf .venv-lock
	@echo "Wrote requirements.lock and requirements-oracles.lock."

COMPILE = PIP_CONFIG_FILE=/dev/null PIP_FIND_LINKS= PIP_EXTRA_INDEX_URL= CUSTOM_COMPILE_COMMAND='make lock' \
	.venv-lock/bin/pip-compile --quiet --no-annotate --generate-hashes --strip-extras --allow-unsafe \
	--no-emit-index-url --no-emit-find-links --no-emit-trusted-host $(OPTIONS)

REQUIREMENTS = import sys, tomllib; \
	p = tomllib.load(open("pyproject.toml", "rb")); \
	lists = [p["build-system"]["requires"], p["project"]["dependencies"]]; \
	lists += [p["dependency-groups"][name] for name in sys.argv[1:]]; \
	print("\n".join(sum(lists, [])))

clean: ## remove the environments and everything else that can be made again
	rm -rf $(VENV) .venv-oracles .venv-lock build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
