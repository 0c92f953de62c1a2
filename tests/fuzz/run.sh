#!/usr/bin/env bash
# Fuzzes with coverage on the stable toolchain: libFuzzer, and the compiler's own instrumentation.
#
#   run.sh SECONDS [TARGET...]      each target that long; new inputs that reach new code are kept in target/corpus
#   run.sh 3600                     an hour each
#
# Fails at the first input that panics, takes longer than a second, or takes more than 64 MB beyond what the target itself needs.
set -euo pipefail
cd "$(dirname "$0")"
seconds=${1:?seconds for each target}
shift
all="urdf companion scenario overrides at mcap messages cycle qp mechanics"
host=$(rustc -vV | sed -n 's/^host: //p')
export RUSTFLAGS="--cfg fuzzing -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table -Cllvm-args=-sanitizer-coverage-trace-compares -Ccodegen-units=4"
cargo build --release --target "$host" --bins ${CARGO_OPTIONS:-}
total=0
for target in ${@:-$all}; do
    mkdir -p "target/corpus/$target" target/artifacts
    log="target/$target.log"
    # The corpus of the repository is read, new inputs go to the first folder. A megabyte of input is the most we promise something about.
    if ! "target/$host/release/$target" "target/corpus/$target" "corpus/$target" -max_total_time="$seconds" -timeout=1 -rss_limit_mb=512 \
        -malloc_limit_mb=64 -max_len=1048576 -len_control=1000 -print_final_stats=1 -artifact_prefix="target/artifacts/$target-" >"$log" 2>&1; then
        echo "$target FAILED:" >&2
        tail -30 "$log" >&2
        exit 1
    fi
    executions=$(sed -n 's/^stat::number_of_executed_units: *//p' "$log")
    slowest=$(sed -n 's/^stat::slowest_unit_time_sec: *//p' "$log")
    peak=$(sed -n 's/^stat::peak_rss_mb: *//p' "$log")
    total=$((total + executions))
    echo "$target: $executions executions, slowest $slowest s, $peak MB at most"
done
echo "all: $total executions"
