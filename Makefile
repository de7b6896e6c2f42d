# Every target does its whole set-up: a virtual environment of its own in .venv, with the versions of constraints.txt.
# `make map` installs what a map needs, `make test` the rest; `make test-full` adds the slow Monte-Carlo sizes, the
# longer notebooks, and examples that are new in every run. `make docs` builds the site, without a network.

PYTHON ?= python3
BIN := .venv/bin
export OPENBLAS_NUM_THREADS ?= 1
# Compiled modules are kept: without them every command that a test starts compiles its own.
unexport PYTHONDONTWRITEBYTECODE
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
MAKE_VENV = $(PYTHON) -m venv --clear
NOT_INSTALLED = { echo "magloc could not be installed: it needs the package index, and a C++ compiler (g++, clang++) or else Zig from that index" >&2; exit 1; }

# The examples need the headers of the C library, which come with a compiler; kernels need none.
EXAMPLES = $(shell for name in c++ g++ clang++; do command -v $$name >/dev/null && echo 'docs/examples/*.cpp' && break; done)
KERNEL_SOURCES = magloc/core/*.cpp adcs/core/*.cpp $(EXAMPLES) -- -std=c++17 -Imagloc/core/include -DMAGLOC_LANES=2
KERNEL_TESTS := tests/magloc/core tests/magloc/fields/test_points.py

.PHONY: map test test-full test-oldest mutation coverage licences sbom audit wheel wheel-aarch64 bench bench-against validation proof docs notebooks pictures chromium lint sanitize clean
.PHONY: ready compiled-tests types style style-of-kernels

map: .venv/installed
	$(BIN)/magloc map

# Two at once: each of them imports and collects all tests, which takes 12 s of processor.
test: ready chromium
	$(BIN)/python -m pytest -q -n 2 -m "not slow"

test-full: ready chromium
	HYPOTHESIS_PROFILE=random $(BIN)/python -m pytest -q -n 3

lint: types style style-of-kernels

types: .venv/installed-test
	$(BIN)/mypy

style: .venv/installed-test
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports --no-cache --no-logo
	$(BIN)/codespell README.md CONTRIBUTING.md CHANGELOG.md arrays magloc adcs sims docs

style-of-kernels: .venv/installed-test
	$(BIN)/clang-format --dry-run -Werror $$(find magloc adcs docs/examples -name '*.cpp' -o -name '*.hpp' -o -name '*.[ch]')
	$(BIN)/clang-tidy --quiet $(KERNEL_SOURCES)

# Tests are compiled once, beside the linters, of which mypy takes as long as all others.
ready: .venv/installed-test
	@$(MAKE) --no-print-directory --jobs=2 types style style-of-kernels compiled-tests

compiled-tests: .venv/installed-test
	@$(BIN)/python -m pytest -qq --collect-only >/dev/null

# Faults of memory: by the analyser of paths, and by the tests of kernels with address and undefined-behaviour
# sanitizers, which end the tests at the first fault.
sanitize: .venv/installed-test
	$(BIN)/clang-tidy --quiet --checks='-*,clang-analyzer-core.*' $(KERNEL_SOURCES)
	cmake -G Ninja -S magloc/core -B build/sanitize -DMAGLOC_SANITIZE=ON -DPython_EXECUTABLE=$(abspath $(BIN)/python) >/dev/null
	cmake --build build/sanitize
	ASAN_OPTIONS=detect_leaks=0 LD_PRELOAD=$$($(CXX) -print-file-name=libasan.so) MAGLOC_KERNELS=$(abspath build/sanitize/kernels.so) \
		$(BIN)/python -m pytest -q -p no:cacheprovider $(KERNEL_TESTS)

# Whether the tests see a change in 300 lines of the code; hours, and it goes on where it was stopped. Other lines and
# more processors: `python -m tests.mutation --seed 1 --count 100 --jobs 4`.
mutation: .venv/installed-test
	$(BIN)/python -m tests.mutation

# Which lines and branches the tests run; fails below 92 and 85 %.
coverage: .venv/installed-test chromium
	rm -f .coverage .coverage.*
	$(BIN)/coverage run -m pytest -q -n 2 -m "not slow"
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report
	$(BIN)/python -m tests.coverage

# The licences of all that is installed; fails where one of the base is copyleft.
licences: .venv/installed-test
	$(BIN)/python -m tests.licences

# What is needed when it runs, as installed, as CycloneDX JSON: dist/magloc.cdx.json.
sbom: .venv/installed-test
	@mkdir -p dist
	$(BIN)/python -m tests.sbom > dist/magloc.cdx.json

# Known weaknesses of all versions that are pinned; fails, too, where the registry does not know one of them.
audit: .venv-supply/installed
	.venv-supply/bin/pip-audit --strict --disable-pip --no-deps --requirement constraints.txt

# Wheel and sdist in dist; what they must hold is looked at by tests/test_wheel.py.
wheel: .venv-supply/installed
	.venv-supply/bin/python -m build --outdir dist

# The wheel for Linux on ARM (64 bits, glibc 2.17 or newer), cross-built by Zig.
wheel-aarch64: .venv-supply/installed
	MAGLOC_ZIG_TARGET=aarch64-linux-gnu.2.17 .venv-supply/bin/python -m build --wheel --outdir dist

bench: .venv/installed-bench
	$(BIN)/python -m tests.bench

# Tables of docs/validation repeated and compared with the page, hours in all: `make validation ONLY="Kalman bank"`.
validation: .venv/installed-test
	$(BIN)/python -m tests.validation $(ONLY)

# Ours and other tools on the same recordings, ten minutes: `make proof ONLY="broad curibio"` for some of them.
proof: .venv/installed-bench
	$(BIN)/python -m tests.proof $(ONLY)

# Processor time against that of another revision, built beside this one: `make bench-against REV=552c0b8`, with
# ISA=baseline for kernels confined to what every processor has.
bench-against: .venv/installed-test
	$(BIN)/python -m tests.bench.against $(REV) --isa $(or $(ISA),best)

docs: .venv/installed-docs
	rm -rf docs/_build docs/reference/names
	$(BIN)/python -m sphinx -b html --fail-on-warning --keep-going --quiet docs docs/_build/html
	@echo "docs/_build/html/index.html"

# Headless Chromium, for the tests in a browser, which are skipped without it.
chromium:
	@for name in chromium chromium-browser google-chrome google-chrome-stable; do \
		command -v $$name >/dev/null && exit 0; \
	done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "installing Chromium for the tests in a browser"; \
		export DEBIAN_FRONTEND=noninteractive; \
		apt-get install -y --no-install-recommends chromium fonts-liberation >/dev/null 2>&1 && exit 0; \
		{ apt-get update && apt-get install -y --no-install-recommends chromium fonts-liberation; } >/dev/null 2>&1 && exit 0; \
	fi; \
	echo "no Chromium: the tests in a browser are skipped (on Debian and Ubuntu: apt-get install chromium)"

# The notebooks executed anew, and the gallery's pictures of them.
notebooks: .venv/installed-test
	$(BIN)/python -m tests.notebooks

# The other pictures of the site, those whose commands, code or scenario changed since they were drawn.
pictures: .venv/installed-test chromium
	$(BIN)/python -m tests.pictures

# The lower bounds of pyproject.toml, installed exactly.
test-oldest: .venv-oldest/installed chromium
	.venv-oldest/bin/python -m pytest -q -n 3 -m "not slow"

.venv/made: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit("magloc needs Python 3.11 or newer, found " + sys.version.split()[0]) if sys.version_info < (3, 11) else None'
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(MAKE_VENV) .venv >/dev/null 2>&1 || \
		{ $(MAKE_VENV) --without-pip .venv && $(PYTHON) -m pip --python $(BIN)/python install --quiet pip; } >/dev/null 2>&1 || \
		{ echo "magloc needs Python's venv and pip: on Debian and Ubuntu, apt-get install python3-venv" >&2; exit 1; }
	@$(PIP) install 'pip>=25.1' || $(NOT_INSTALLED) # the first that installs dependency groups
	@touch $@

.venv/installed: .venv/made
	$(PIP) install --constraint constraints.txt --editable '.[maps]' || $(NOT_INSTALLED)
	@touch $@

# All at once: one after the other, what both need would be looked up twice. A module is compiled when a test imports
# it: pip would compile all of them, three quarters for nothing.
.venv/installed-test: .venv/made
	$(PIP) install --no-compile --constraint constraints.txt --editable '.[all]' --group test || $(NOT_INSTALLED)
	@touch .venv/installed $@

.venv/installed-bench: .venv/installed-test
	$(PIP) install --constraint constraints.txt --editable '.[all]' --group test --group bench
	@touch $@

.venv/installed-docs: .venv/installed
	$(PIP) install --constraint constraints.txt --editable '.[all]' --group docs
	@touch $@

.venv-oldest/installed: pyproject.toml constraints-oldest.txt
	$(MAKE_VENV) .venv-oldest
	.venv-oldest/bin/python -m pip --disable-pip-version-check --quiet install 'pip>=25.1'
	.venv-oldest/bin/python -m pip --disable-pip-version-check --quiet install --constraint constraints-oldest.txt --editable '.[all]' --group test
	@touch $@

.venv-supply/installed: constraints.txt
	$(MAKE_VENV) .venv-supply
	.venv-supply/bin/python -m pip --disable-pip-version-check --quiet install --constraint constraints.txt build pip-audit
	@touch $@

clean:
	rm -rf .venv .venv-oldest .venv-supply build dist magloc/core/kernels.* magloc/core/_declarations.py *.egg-info docs/_build docs/gallery/notebooks docs/reference/commands docs/reference/headers docs/reference/names
	find . -name __pycache__ -prune -exec rm -rf {} +
