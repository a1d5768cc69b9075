#!/usr/bin/env bash
# Slurm on the two hosts of two_hosts.sh, to try runs under srun: host 1 has the controller, both have a daemon. Needs what
# two_hosts.sh needs, and Debian's slurm-wlm, munge and libpmix2.
#
#   scripts/two_hosts_slurm.sh up                     make the hosts, start Slurm
#   scripts/two_hosts_slurm.sh run [OPTIONS] PROGRAM ..   srun on host 1, for example run -N 2 -n 4 --mpi=pmix PROGRAM ..
#   scripts/two_hosts_slurm.sh down                   stop Slurm, remove the hosts
#
# Its state is in /tmp/loomtree_slurm, or in the folder that LOOMTREE_SLURM names.
set -euo pipefail
shopt -s inherit_errexit

hosts="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)/two_hosts.sh"
name=loomhost
address=10.93.7
state="${LOOMTREE_SLURM:-/tmp/loomtree_slurm}"

# Runs a command on a host: as two_hosts.sh does, but /sys stays, because the daemon wants to see control groups.
on() {
    local inside='hostname "$0" && mount -t tmpfs none /dev/shm && exec sh -c "$1"'
    nsenter --net="/run/netns/$name$1" unshare --mount --uts sh -c "$inside" "$name$1" "$2"
}

write_configuration() {
    cat >"$state/slurm.conf" <<EOF
ClusterName=loomtree
SlurmctldHost=${name}1($address.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket=$state/munge/socket
CredType=cred/munge
StateSaveLocation=$state/controller
SlurmdSpoolDir=$state/%n
# PMIx keeps its sockets here; the hosts share /tmp, so each needs a folder of its own.
TmpFS=$state/%n.tmp
SlurmctldPidFile=$state/pids/controller
SlurmdPidFile=$state/pids/%n
SlurmctldLogFile=$state/controller.log
SlurmdLogFile=$state/%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/linear
# The processors below are more than there are.
SlurmdParameters=config_overrides
ReturnToService=2
NodeName=${name}1 NodeHostname=${name}1 NodeAddr=$address.1 CPUs=64
NodeName=${name}2 NodeHostname=${name}2 NodeAddr=$address.2 CPUs=64
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
EOF
}

export SLURM_CONF="$state/slurm.conf"
case "${1:-}" in
up)
    [ ! -e "$state" ] || { echo "$state is there already: $0 down" >&2; exit 2; }
    mkdir -p "$state"/{munge,controller,pids,"${name}1","${name}2","${name}1.tmp","${name}2.tmp"}
    write_configuration
    "$hosts" up
    (umask 077 && head -c 1024 /dev/urandom >"$state/munge/key")
    munged --force --key-file="$state/munge/key" --socket="$state/munge/socket" --pid-file="$state/pids/munge" \
        --log-file="$state/munge/log" --seed-file="$state/munge/seed"
    on 1 slurmctld
    for host in 1 2; do on "$host" "slurmd -N $name$host"; done
    for _ in $(seq 100); do
        [ "$(on 1 "sinfo -h -N -t idle -o %N" | wc -l)" -lt 2 ] || exit 0
        sleep 0.1
    done
    echo "Slurm does not start; see $state/*.log" >&2
    exit 1
    ;;
run)
    shift
    export OMPI_MCA_btl_tcp_if_include="$address.0/24" OMPI_MCA_mpi_yield_when_idle=1
    export OMPI_MCA_btl_vader_single_copy_mechanism=none
    on 1 "exec srun $(printf '%q ' "$@")"
    ;;
down)
    for file in "$state"/pids/*; do
        [ -e "$file" ] || continue
        pid=$(cat "$file")
        kill "$pid" || continue
        while kill -0 "$pid" 2>/dev/null; do sleep 0.1; done
    done
    [ ! -e "/run/netns/${name}1" ] || "$hosts" down
    rm -rf "$state"
    ;;
*)
    sed -n '2,10s/^# \{0,1\}//p' "${BASH_SOURCE[0]}" >&2
    exit 2
    ;;
esac
