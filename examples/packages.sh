# Sourced by run.sh here and in tests/: which Debian packages talus needs, and how they get there.

build_packages="gcc g++ meson ninja-build pkg-config libtiff-dev libgeotiff-dev libproj-dev libgeographiclib-dev
libopenexr-dev libmeshoptimizer-dev libpng-dev libdeflate-dev libjansson-dev libpopt-dev libkissfft-dev libcairo2-dev libmicrohttpd-dev libsqlite3-dev scdoc"
test_packages="gnuplot-nox libcmocka-dev clang clang-format libclang-rt-14-dev git"

# Installs those of the named packages that are missing; does nothing, and asks nothing, when all are there.
need_packages() {
    missing=
    for package in "$@"; do
        dpkg-query -W -f '${Status}\n' "$package" 2>/dev/null | grep -q 'ok installed' || missing="$missing $package"
    done
    [ -n "$missing" ] || return 0
    command -v apt-get >/dev/null || {
        echo "These Debian packages, or what your system calls them, are needed:$missing" >&2
        return 1
    }
    sudo=
    [ "$(id -u)" -eq 0 ] || sudo=sudo
    echo "Installing$missing" >&2
    $sudo apt-get update -q >&2 &&
        $sudo env DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends $missing >&2
}
