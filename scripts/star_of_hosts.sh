#!/usr/bin/env bash
# Prints a topology file: N hosts with one GPU each on one network, for `loomtree predict`. Links and device as in
# topology/cluster_8x4.toml: 12 GB/s and 2 us from a host to the network, an A100 with PCIe.
#
#   scripts/star_of_hosts.sh N > hosts_N.toml
set -euo pipefail

hosts=${1:?how many hosts}

echo "name = \"star of $hosts hosts\""
if [ "$hosts" -gt 1 ]; then echo 'switches = ["network"]'; fi
echo 'gpus = ['
for ((host = 0; host < hosts; host++)); do
    echo "    { id = $host, name = \"gpu$host\", host = \"host$host\" },"
done
echo ']'
if [ "$hosts" -gt 1 ]; then
    echo 'links = ['
    for ((host = 0; host < hosts; host++)); do
        echo "    { between = [\"network\", \"gpu$host\"], bandwidth_gb_s = 12.0, latency_us = 2.0, duplex = \"full\" },"
    done
    echo ']'
fi
sed -n '/^\[device\]/,$p' "$(dirname "$0")/../topology/cluster_8x4.toml"
