#!/usr/bin/env bash
# Builds driml with the feature `cuda`, as `cargo build --release --features cuda` does where a CUDA toolkit is installed.
# This one needs neither a GPU nor a toolkit: the compiler and the libraries come from the Python package index, pinned in
# requirements.txt, into the cache folder. It installs no driver and writes to nothing but cache and target folder.

set -euo pipefail
unset CDPATH
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
root=$(cd "$here/../.." && pwd)

say() { printf '=== %s\n' "$*"; }
fail() { printf 'error: %s\n' "$*" >&2; exit 1; }

usage() {
    cat <<'TEXT'
Usage: deploy/cuda/build.sh [--compute-cap N] [--system-toolkit]

  --compute-cap N    compute capability of the GPU without its point, such as 80, 86, 89, 90 or 100 [default: 90]
                     One: the kernels are compiled once. From 90 on the program runs on that capability only;
                     below, also on newer ones, for which the driver compiles the kernels when it starts.
  --system-toolkit   take the CUDA toolkit of CUDA_HOME, or the one whose nvcc is on the PATH, and fetch nothing

DRIML_CACHE moves the cache folder, DRIML_OFFLINE=1 forbids fetching, CARGO_TARGET_DIR moves the target folder.
TEXT
}

compute_cap=90
system_toolkit=no
while [ $# -gt 0 ]; do
    case $1 in
        --compute-cap) compute_cap=${2:-}; shift ;;
        --compute-cap=*) compute_cap=${1#*=} ;;
        --system-toolkit) system_toolkit=yes ;;
        -h | --help) usage; exit ;;
        *) usage >&2; exit 64 ;;
    esac
    shift || break
done
[[ $compute_cap =~ ^[0-9]{2,3}$ ]] || fail "--compute-cap takes one number of two or three digits, such as 90, not \"$compute_cap\""

offline=no
[ "${DRIML_OFFLINE:-0}" = 0 ] || offline=yes

# --- What it needs -------------------------------------------------------------------------------------------------------

if ! command -v cargo >/dev/null && [ -f "${CARGO_HOME:-$HOME/.cargo}/env" ]; then
    # shellcheck disable=SC1091
    . "${CARGO_HOME:-$HOME/.cargo}/env"
fi
command -v cargo >/dev/null || fail "cargo is not there: install Rust 1.90 or newer, for example from https://rustup.rs"
command -v c++ >/dev/null || fail "there is no C++ compiler: install build-essential (Debian, Ubuntu) or gcc-c++ (Fedora)"

# --- The toolkit ---------------------------------------------------------------------------------------------------------

# Unpacks the pinned wheels into the folder $1, whole or not at all.
fetch_toolkit() {
    local folder=$1 fresh
    [ "$offline" = no ] || fail "DRIML_OFFLINE=1 forbids fetching the CUDA compiler, and it is not (whole) in $folder:
  run this once without DRIML_OFFLINE, set DRIML_CACHE to a cache folder that has it, or use --system-toolkit"
    [ "$(uname -sm)" = "Linux x86_64" ] || fail "the wheels are for Linux on x86-64: elsewhere use --system-toolkit"
    local -a pip=()
    if pip --version >/dev/null 2>&1; then pip=(pip)
    elif pip3 --version >/dev/null 2>&1; then pip=(pip3)
    elif python3 -m pip --version >/dev/null 2>&1; then pip=(python3 -m pip)
    else fail "there is no pip to fetch the CUDA compiler with: install python3-pip, or use --system-toolkit"
    fi
    say "fetching the CUDA compiler and libraries: 0.7 GB, 1.2 GB unpacked, into $folder"
    mkdir -p "$(dirname "$folder")"
    fresh=$(mktemp -d "$folder.XXXXXX")
    # shellcheck disable=SC2064
    trap "rm -rf '$fresh'" EXIT
    PIP_USER=0 PIP_REQUIRE_VIRTUALENV=0 "${pip[@]}" install --quiet --no-deps --only-binary :all: --require-hashes \
        --no-cache-dir --no-compile --disable-pip-version-check --no-input --target "$fresh" --requirement "$here/requirements.txt" ||
        fail "pip could not fetch the CUDA compiler (see above): is the network reachable?"
    cp "$here/requirements.txt" "$fresh/fetched.txt"
    chmod 755 "$fresh"
    rm -rf "$folder"
    mv "$fresh" "$folder"
}

# Makes the folder $2 for the linker of the toolkit $1: the names without a version that it looks for, and a libcuda.so
# that has every name of the driver's interface and does nothing. The real one comes with the driver, as libcuda.so.1;
# this one does not bear that name, so that no program ever loads it.
make_links() {
    local toolkit=$1 links=$2 name
    mkdir -p "$links"
    for name in cublas cublasLt cudart curand nvrtc; do
        local -a found=("$toolkit/lib/lib$name.so."*)
        [ -f "${found[0]}" ] || fail "$toolkit/lib has no lib$name: delete $(dirname "$links") and run this again"
        ln -sfn "$(realpath --relative-to "$links" "${found[0]}")" "$links/lib$name.so"
    done
    grep -oE '\bcu[A-Z][A-Za-z0-9_]*' "$toolkit/include/cuda.h" | sort -u | sed 's/.*/void &(void) {}/' |
        c++ -shared -fPIC -Wl,-soname,libcuda.so.1 -x c -o "$links/libcuda.so" -
}

if [ "$system_toolkit" = yes ]; then
    if [ -z "${CUDA_HOME:-}" ]; then
        nvcc=$(command -v nvcc) || fail "--system-toolkit: neither is CUDA_HOME set, nor is nvcc on the PATH"
        CUDA_HOME=$(dirname "$(dirname "$(readlink -f "$nvcc")")")
    fi
    [ -x "$CUDA_HOME/bin/nvcc" ] || fail "--system-toolkit: there is no $CUDA_HOME/bin/nvcc"
    CUDA_HOME=$(realpath "$CUDA_HOME")
    # The toolkit brings its own stub of the driver's library.
    links=$CUDA_HOME/lib64/stubs libraries=$CUDA_HOME/lib64
else
    folder=$(realpath -m "${DRIML_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/driml}/cuda-13.0")
    cmp -s "$here/requirements.txt" "$folder/fetched.txt" || fetch_toolkit "$folder"
    CUDA_HOME=$folder/nvidia/cu13
    links=$folder/links libraries=$CUDA_HOME/lib
    [ -f "$links/libcuda.so" ] || make_links "$CUDA_HOME" "$links"
    export CUDARC_CUDA_VERSION=13000
fi
export CUDA_HOME CUDA_PATH=$CUDA_HOME CUDA_COMPUTE_CAP=$compute_cap PATH=$CUDA_HOME/bin:$PATH
# The compiler that links reads this. RUSTFLAGS would do too, but with other flags every crate is compiled again.
export LIBRARY_PATH=$links${LIBRARY_PATH:+:$LIBRARY_PATH}

# --- The program ---------------------------------------------------------------------------------------------------------

target=$(realpath -m "${CARGO_TARGET_DIR:-$root/target}")
# A folder for each compiler: cargo would not notice another one, and keep the kernels that the old one made.
version=$("$CUDA_HOME/bin/nvcc" --version | sed -n 's/.*release \([0-9.]*\),.*/\1/p')
[ -n "$version" ] || fail "$CUDA_HOME/bin/nvcc does not say its version"
built=$target/cuda-$version
options=(--release --locked --features cuda -p driml --bin driml --target-dir "$built")
[ "$offline" = no ] || options+=(--offline)
say "building driml for compute capability $compute_cap with CUDA $version in $CUDA_HOME; candle's kernels take several minutes"
# The program notes where CUDA's libraries are, for itself and for those that they load in turn.
(cd "$root" && cargo rustc "${options[@]}" -- -C link-arg=-Wl,--disable-new-dtags -C "link-arg=-Wl,-rpath,$libraries")
mkdir -p "$target/release"
# Renamed into place, so that one that runs is not written over.
cp "$built/release/driml" "$target/release/.driml.$$"
mv -f "$target/release/.driml.$$" "$target/release/driml"
say "$target/release/driml is ready after $SECONDS s; \`driml doctor --cuda\` names its GPUs"
