# Entry points of the repository; each does its own set-up. `make help` lists them.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help
.PHONY: help setup build demo test check settings drivers traces fuzz simulate soak bench accept ablation dist release-protos web

help: ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1	/' | expand -t 20

setup: ## installs a Vulkan driver if the machine has none
	@scripts/setup.sh

build: setup ## the binary `fathom`
	@cargo build --workspace --bin fathom

demo: build ## trains a synthetic wreck with two workers in 2x2 partitions, without a GPU on the CPU
	@scripts/demo.sh

test: ## every test; those that need a GPU run on Mesa's CPU driver, those of a database on a PostgreSQL that is installed
	@scripts/setup.sh --for-tests
	scripts/drivers.sh fetch || true
	scripts/web.sh check || [ $$? -eq 3 ]
	cargo test --workspace
	scripts/web.sh headless quick || [ $$? -eq 3 ]

check: ## formatting, lints, scripts, documentation, shaders, protos, tidiness; CI runs this before the tests
	@cargo fmt --all --check
	scripts/shellcheck.sh
	scripts/charts.py
	cargo clippy --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps
	cargo test --workspace --test shaders_validate --test languages --test compatible --test tidy

web: ## builds the pages for browsers (web/dist) from web/src; needs npm and its registry
	@scripts/web.sh build

settings: ## docs/using/settings.md and the example files in deploy/, from the settings in the source
	@FATHOM_WRITE_SETTINGS=1 cargo test --workspace --bin fathom settings_page_and_example_files_are_current

drivers: ## kernels, a short training and the validation layer on every driver that a CPU runs; 25 minutes on 2 cores
	@scripts/drivers.sh

traces: ## builds the feature `otel`, which CI does not, and tests that spans arrive at a collector; 6 minutes on 2 cores
	@cargo test -p fathom-cli --features otel --test traces

fuzz: ## a million hostile inputs (or INPUTS=N) for each reader of foreign files and messages; half an hour
	@FATHOM_FUZZ_INPUTS=$${INPUTS:-1000000} cargo test --workspace fuzzed -- --nocapture

simulate: ## coordinator, workers and users over a simulated network: SEEDS=10000 runs with faults, or SEED=7 alone with its history
	@cargo build --workspace --bin fathom-simulation
	FATHOM_SIMULATION_SEEDS="$${SEEDS:-10000}" FATHOM_SIMULATION_SEED="$${SEED:-}" "$${CARGO_TARGET_DIR:-target}/debug/fathom-simulation"

soak: build ## random kills of real processes during FATHOM_KILLS_ROUNDS=40 jobs, all kills on PostgreSQL and a bucket, a week of calls and of jobs, FATHOM_POWER_CUTS=10000 power cuts; an hour
	@cargo test --workspace --test kills soak:: -- --ignored --nocapture
	FATHOM_KILLS_STORE=postgres cargo test --workspace --test kills
	cargo test --workspace --test week -- --ignored --nocapture
	cargo test --workspace --test cluster memory:: -- --ignored --nocapture --test-threads=1
	scripts/web.sh headless
	cargo test -p fathom-coordinator --test power_cuts -- --ignored --nocapture

bench: build ## times of the trainer on this machine, compared with BASELINE=<commit>
	@scripts/bench.sh

accept: build ## reruns the claimed figures into bench/history.jsonl and BENCHMARKS.md; hours
	@scripts/accept.sh

ablation: build ## effect of each part of the water and the partitions, as a table of BENCHMARKS.md, and of method wsgs; hours
	@scripts/ablation.py
	scripts/surface_ablation.sh

dist: ## a stripped binary for this machine's Linux with checksum and licences, under out/dist; 15 minutes on 2 cores
	@scripts/dist.sh

release-protos: ## writes the protos of this version, which `make check` compares later ones with
	@version=$$(sed -nE 's/^version = "(.*)"/\1/p' Cargo.toml | head -n 1)
	cargo build --workspace --example descriptor
	"$${CARGO_TARGET_DIR:-target}/debug/examples/descriptor" >proto/released/$$version.bin
	printf 'proto/released/%s.bin is written; name it in proto/tests/compatible.rs and commit both\n' "$$version"
