#!/bin/sh
# Builds the probe, looks for what must not be in it, runs it, and proves that the search finds a leak. Exit code 0: all as it should be.
set -eu
cd "$(dirname "$0")"
target=${CARGO_TARGET_DIR:-target}
library=$target/release/liblink_probe.a

# Names of the standard library's runtime, and of the C library's allocator. `core` and `alloc` may stay.
forbidden='_ZN3std|_RNv[A-Za-z0-9]*3std|__rust_start_panic|rust_eh_personality|(^| )(malloc|calloc|realloc|posix_memalign|aligned_alloc)$'

leaks() {
    nm -A "$1" 2>/dev/null | grep -E "$forbidden" || true
}

cargo build --release
found=$(leaks "$library")
if [ -n "$found" ]; then
    echo "the probe contains the standard library or the C allocator:" >&2
    echo "$found" | head -20 >&2
    exit 1
fi

# The search must find a leak: the same library with a call of malloc.
if cargo build --features leak 2>/dev/null; then
    if [ -z "$(leaks "$target/debug/liblink_probe.a")" ]; then
        echo "the search does not find a call of malloc" >&2
        exit 1
    fi
else
    echo "the probe with the leak does not build" >&2
    exit 1
fi

# And a crate that pulls in the standard library must not build: two panic handlers.
if cargo check --features standard >"$target/standard.log" 2>&1; then
    echo "the probe builds together with the standard library" >&2
    exit 1
fi
if ! grep -q "panic_impl" "$target/standard.log"; then
    echo "the build with the standard library failed for another reason:" >&2
    tail -20 "$target/standard.log" >&2
    exit 1
fi

cc main.c "$library" -o "$target/probe"
"$target/probe"
echo "link_probe: no standard library, no allocation after construction; both negative checks caught"
