# SPDX-License-Identifier: GPL-3.0-or-later
# make preview [SCENE=file]   sets everything up, draws the scene, prints what building its tree cost per thread count
# make test                   sets everything up, runs the C++ and the Python tests
# make long-run [RAYS=1e8]    judges so many hard rays in exact arithmetic, and says what follows from finding no error
# make test-neon              the C++ tests under an emulator of ARM; the same trees, hits and light samples on all instruction sets
# make package                build/espalier-VERSION.zip, the extension as users install it
# make bench [BENCH=--quick]  measures builds and rays beside Embree on the meshes it finds; BENCH=--help tells more
# make report [REPORT=--quick] one page: speed against error beside other tracers, and the pixels of Cycles
# make sanitize               the C++ tests under the address, undefined-behaviour and thread sanitizers
# make lint | make format     checks or applies the style of Python and C++
# make blenders               the other Blenders the installation tests run in (root, 4 GB, kept in the user's cache)
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.PHONY: preview test test-native test-neon long-run package bench report sanitize lint format blenders native system python clean

SCENE ?= build/scenes/interior.blend
CACHE := $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/espalier
JOBS := $(shell nproc)
# What Blender's module loads, and what the native module is compiled with.
SYSTEM := libgl1 libgomp1 libsm6 libxfixes3 libxi6 libxkbcommon0 libxrender1 libxxf86vm1 libhwy-dev \
	$(if $(shell command -v c++),,g++)
# Who is measured against, and what writes the figures down.
PEERS := libembree-dev nlohmann-json3-dev
# What the tests and the judge of hits are compiled with.
TEST_SYSTEM := libgmp-dev libgtest-dev
NATIVE := CMakeLists.txt CMakePresets.json pyproject.toml $(shell find native -type f)
ADDON := blender_manifest.toml $(wildcard addon/*.py)
export PATH := $(CURDIR)/.venv/bin:$(PATH)

preview: native $(if $(filter build/scenes/%,$(SCENE)),$(SCENE))
	@python -m addon preview "$(SCENE)" \
		--output build/preview/preview.png --json build/preview/timings.json

build/scenes/%.blend: scenes/%.py scenes/kit.py | python
	@mkdir -p build/scenes
	python $< $@

test: test-native native package
	@tools/environment .venv "3.11 3.13" -r requirements/test.txt
	python -m pytest

test-native: python
	@tools/need $(TEST_SYSTEM)
	cmake --preset release -DESPALIER_TESTS=ON
	cmake --build --preset release -j $(JOBS)
	ctest --preset release -j $(JOBS) --output-on-failure

RAYS := 1e8
long-run: test-native native
	@tools/environment .venv "3.11 3.13" -r requirements/test.txt
	python -m tests.exactness $(RAYS)

test-neon: python
	@tools/need $(TEST_SYSTEM) g++-aarch64-linux-gnu qemu-user googletest
	cmake --preset release
	cmake --build --preset release -j $(JOBS) --target espalier_fingerprint
	cmake --preset neon -Wno-deprecated
	cmake --build --preset neon -j $(JOBS)
	ctest --preset neon -j $(JOBS)
	qemu-aarch64 -L /usr/aarch64-linux-gnu build/neon/espalier_fingerprint >build/neon/fingerprint
	for set in $$(build/release/espalier_fingerprint sets); do \
		ESPALIER_SIMD=$$set build/release/espalier_fingerprint | diff - build/neon/fingerprint || exit; \
		echo "The same trees, hits and light samples on $$set and on neon"; done

package: build/package.stamp
build/package.stamp: $(NATIVE) $(ADDON) tools/package.py | native
	python tools/package.py
	touch $@

bench: native
	@tools/need $(PEERS)
	-@tools/environment .venv "3.11 3.13" -r requirements/report.txt  # embreex, which not every machine can get
	cmake --preset release -B build/bench -DESPALIER_TESTS=OFF -DESPALIER_BENCH=ON >/dev/null
	cmake --build build/bench -j $(JOBS)
	python -m bench.run $(BENCH)

report: native build/bench/bench.json
	@tools/need $(TEST_SYSTEM)
	@tools/environment .venv "3.11 3.13" -r requirements/test.txt
	cmake --preset release -DESPALIER_TESTS=ON
	cmake --build --preset release -j $(JOBS) --target espalier_judge espalier_plain
	python -m addon report $(REPORT)

build/bench/bench.json:
	$(MAKE) bench BENCH="--quick --meshes sponza,dragon,sculpture"

sanitize: sanitize-asan sanitize-tsan
sanitize-%: python
	@tools/need $(TEST_SYSTEM)
	cmake --preset $*
	cmake --build --preset $* -j $(JOBS)
	ctest --preset $* --output-on-failure

lint: python
	@tools/need $(TEST_SYSTEM) $(PEERS)
	@tools/environment .venv "3.11 3.13" -r requirements/test.txt
	@tools/environment .venv "3.11 3.13" -r requirements/lint.txt
	ruff check .
	ruff format --check .
	mypy addon bench scenes tests tools
	git ls-files '*.h' '*.cpp' | xargs clang-format --dry-run -Werror
	cmake --preset release -B build/lint -DESPALIER_MODULE=ON -DESPALIER_BENCH=ON -Dpybind11_DIR="$$(python -m pybind11 --cmakedir)" >/dev/null
	git ls-files '*.cpp' | xargs -P $(JOBS) -n 1 clang-tidy --quiet -p build/lint

format: python
	@tools/environment .venv "3.11 3.13" -r requirements/lint.txt
	ruff check --fix .
	ruff format .
	git ls-files '*.h' '*.cpp' | xargs clang-format -i

blenders: system
	@tools/environment $(CACHE)/bpy-4.2.23 3.11 bpy==4.2.23
	@tools/environment $(CACHE)/bpy-5.0.1 3.11 bpy==5.0.1
	@tools/environment $(CACHE)/bpy-5.2.3 3.13 bpy==5.2.3
	@tools/real-blender

# The native module is installed from the wheel that users get, and only when a source is newer.
native: .venv/native.stamp
.venv/native.stamp: $(NATIVE) | python
	python tools/package.py wheel
	touch $@

python: system
	@tools/environment .venv "3.11 3.13" -r requirements/run.txt

system:
	@tools/need $(SYSTEM)

clean:
	rm -rf build .venv
