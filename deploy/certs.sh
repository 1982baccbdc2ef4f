#!/bin/sh
# Makes the certificates for `--tls-dir`: an authority, and for each process a certificate whose common name is its role.
# What is there already stays: a second call adds what is missing, to an existing authority.

set -eu
unset CDPATH

usage() {
    cat <<'TEXT'
Usage: deploy/certs.sh DIR [--actors N] [--host NAME_OR_ADDRESS]... [--days DAYS]

Makes in DIR, with openssl, what is not there yet:
  ca.pem, ca.key                          the authority, valid for ten times as long; keep its key on this machine
  replay-server.pem, replay-server.key    for the side that listens, under each --host
  learner.pem, learner.key                and observer.pem, observer.key
  actor-0.pem, actor-0.key, ...           for N actors, numbers 0 to N - 1

  --actors N    number of actors with a certificate, at most 1024 [default: 1]
  --host H      a name or address by which others reach the replay server; may be given several times [default: localhost,
                127.0.0.1 and ::1]. It counts when replay-server.pem is made: to change it, remove that file first
  --days DAYS   how long certificates are valid; then a process is disconnected [default: 365]

Each process needs three files of DIR on its machine: ca.pem, ROLE.pem and ROLE.key. To replace a certificate, remove its .pem and
.key and run this again. A key gives its role to anyone who has it; ca.key gives every role.
TEXT
}

fail() { printf 'error: %s\n' "$*" >&2; exit 1; }

# Whether an argument is a whole number from $2 to $3.
whole() {
    case $1 in '' | *[!0-9]* | 0?*) return 1 ;; esac
    [ "${#1}" -le 6 ] && [ "$1" -ge "$2" ] && [ "$1" -le "$3" ]
}

dir='' actors=1 days=365 names=''
while [ $# -gt 0 ]; do
    case $1 in
        -h | --help) usage; exit 0 ;;
        --actors | --host | --days) [ $# -gt 1 ] || fail "$1 needs a value; see --help" ;;
    esac
    case $1 in
        --actors) actors=$2; shift ;;
        --days) days=$2; shift ;;
        --host)
            case $2 in
                '' | *[!A-Za-z0-9._:-]*) fail "--host $2 is neither a name nor an address" ;;
                *:*) names="$names,IP:$2" ;;
                *[!0-9.]*) names="$names,DNS:$2" ;;
                *.*.*.*) names="$names,IP:$2" ;;
                *) names="$names,DNS:$2" ;;
            esac
            shift ;;
        -*) fail "$1 is no argument; see --help" ;;
        *) [ -z "$dir" ] || fail "$1: there is one DIR, which is $dir"; dir=$1 ;;
    esac
    shift
done
[ -n "$dir" ] || { usage >&2; exit 64; }
whole "$actors" 0 1024 || fail "--actors $actors: 0 to 1024 actors can have a certificate"
whole "$days" 1 36500 || fail "--days $days: take 1 to 36500"
names=${names#,}
hosts=$names
[ -n "$names" ] || names='DNS:localhost,IP:127.0.0.1,IP:::1'
command -v openssl >/dev/null || fail "openssl is not there: install the package openssl"

umask 077
mkdir -p "$dir"
cd "$dir"
work=$(mktemp -d ./.making-XXXXXX)
trap 'rm -rf "$work"' EXIT INT TERM

# A key that nobody else can read, under a name of its own until all is done.
key() { openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$work/$1.key" 2>/dev/null; }
put() {
    chmod 600 "$work/$1.key"
    chmod 644 "$work/$1.pem"
    mv "$work/$1.key" "$1.key"
    mv "$work/$1.pem" "$1.pem"
    printf 'made %s/%s.pem and %s.key\n' "$dir" "$1" "$1"
}

if [ ! -e ca.pem ]; then
    [ ! -e ca.key ] || fail "$dir/ca.key is there and ca.pem is not: put ca.pem back, or remove ca.key and all other files"
    key ca
    # Times are compared by other machines' clocks, which may be behind.
    authority_days=$((days * 10 > 36500 ? 36500 : days * 10))
    openssl req -x509 -new -key "$work/ca.key" -sha256 -days "$authority_days" -subj "/CN=driml authority" \
        -addext 'basicConstraints=critical,CA:TRUE,pathlen:0' -addext 'keyUsage=critical,keyCertSign,cRLSign' \
        -out "$work/ca.pem" 2>"$work/said" || fail "making the authority: $(cat "$work/said")"
    put ca
fi

# A certificate of role $1, for the side $2 of a connection, with more extensions in $3.
certificate() {
    [ ! -e "$1.pem" ] || [ ! -e "$1.key" ] || return 0
    [ ! -e "$1.pem" ] && [ ! -e "$1.key" ] || fail "$dir has one of $1.pem and $1.key alone: put the other back, or remove it"
    [ -e ca.key ] || fail "$dir/ca.key is not there, and only with it can certificates be made: call this where the authority was made"
    key "$1"
    printf 'basicConstraints=critical,CA:FALSE\nkeyUsage=critical,digitalSignature\nextendedKeyUsage=%s\n%s\n' "$2" "$3" >"$work/extensions"
    openssl req -new -key "$work/$1.key" -subj "/CN=$1" -out "$work/request" 2>"$work/said" \
        && openssl x509 -req -in "$work/request" -CA ca.pem -CAkey ca.key -set_serial "0x01$(openssl rand -hex 15)" -sha256 \
            -days "$days" -extfile "$work/extensions" -out "$work/$1.pem" 2>"$work/said" \
        || fail "making $1.pem: $(cat "$work/said")"
    put "$1"
}

[ -z "$hosts" ] || [ ! -e replay-server.pem ] ||
    printf 'warning: %s/replay-server.pem stays, for the hosts it was made for: to change them, remove it and its .key first\n' "$dir" >&2
certificate replay-server serverAuth "subjectAltName=$names"
certificate learner clientAuth ''
certificate observer clientAuth ''
number=0
while [ "$number" -lt "$actors" ]; do
    certificate "actor-$number" clientAuth ''
    number=$((number + 1))
done
