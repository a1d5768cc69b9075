#!/usr/bin/env bash
# Starts a run by hand: the coordinator, then its workers one by one. What `loomtree run` does in one go, in pieces that a
# debugger, a profiler or a cluster tool can get between.
#
#   scripts/launch.sh SCENE N [flags of loomtree run ...]
#   scripts/launch.sh scenes/flag.toml 4 --frames 10 --out out/by-hand
#
# One worker in a debugger: LOOMTREE_BY_HAND=2 scripts/launch.sh scenes/flag.toml 4 --heartbeat 86400
# starts all workers but rank 2, whose command it prints; run that in another terminal under the debugger
# (gdb --args loomtree-worker --run ... --rank 2) within five minutes. The heartbeat keeps the coordinator from taking a
# worker at a breakpoint for a hung one.
#
# LOOMTREE_BIN      folder of loomtree-coordinator and loomtree-worker [default: target/release, else the PATH]
# LOOMTREE_BY_HAND  ranks to leave out, separated by blanks
#
# Ctrl-C reaches the coordinator only: it stops after the current step, a second one at once; the workers follow it.
# Exit code: the coordinator's.
set -u

if [ $# -lt 2 ] || ! [[ $2 =~ ^[0-9]+$ ]]; then
    echo "error: usage: $0 SCENE N [flags of loomtree run ...]" >&2
    exit 2
fi
scene=$1
workers=$2
shift 2

folder=${LOOMTREE_BIN:-$(dirname "${BASH_SOURCE[0]}")/../target/release}
program() {
    if [ -x "$folder/$1" ]; then
        echo "$folder/$1"
    elif [ -n "${LOOMTREE_BIN:-}" ] || ! command -v "$1"; then
        echo "error: no $1 in $folder: build it (cargo build --release) or set LOOMTREE_BIN" >&2
        return 1
    fi
}
coordinator=$(program loomtree-coordinator) || exit 2
worker=$(program loomtree-worker) || exit 2

id_file=$(mktemp) || exit 1
trap 'rm -f "$id_file"' EXIT

# Job control gives the coordinator a process group of its own: a Ctrl-C on the terminal reaches this script, which
# passes it on exactly once.
set -m
"$coordinator" "$scene" --workers "$workers" "$@" >"$id_file" &
coordinator_pid=$!
set +m
trap 'kill -INT "$coordinator_pid" 2>/dev/null' INT
trap 'kill -TERM "$coordinator_pid" 2>/dev/null' TERM
# Under nohup the signal is ignored, and this line changes nothing about that.
trap 'kill -HUP "$coordinator_pid" 2>/dev/null' HUP

# The coordinator prints the run's identifier once workers may come.
run=
while [ -z "$run" ] && kill -0 "$coordinator_pid" 2>/dev/null; do
    read -r run <"$id_file" || sleep 0.05
done

if [ -n "$run" ]; then
    for ((rank = 0; rank < workers; rank++)); do
        case " ${LOOMTREE_BY_HAND:-} " in
        *" $rank "*) echo "start rank $rank by hand: $worker --run $run --rank $rank" >&2 ;;
        *) (
            trap '' INT
            exec "$worker" --run "$run" --rank "$rank"
        ) & ;;
        esac
    done
fi

# A trapped signal ends `wait` early; then the coordinator is still there.
while :; do
    wait "$coordinator_pid"
    code=$?
    kill -0 "$coordinator_pid" 2>/dev/null || break
done
wait "$coordinator_pid" 2>/dev/null
last=$?
[ "$last" -ne 127 ] && code=$last
# Workers end with their coordinator.
wait
exit "$code"
