#!/usr/bin/env bash
# Makes the pictures of the README again: runs the shipped scenes up to the frame that is shown, and draws it. About two
# hours on two cores, most of it for twisting.
#
#   scripts/gallery.sh [SCENE ..]      all of them without a name
set -euo pipefail
cd "$(dirname "$0")/.."

program=target/release/loomtree
[ -x "$program" ] || cargo build --release

declare -A frame=([dress]=120 [karate]=40 [princess]=100 [skirt]=80 [tshirt]=50 [curtain]=60 [twisting]=110)
[ "$#" -gt 0 ] || set -- "${!frame[@]}"

mkdir -p docs/pictures
for scene in "$@"; do
    if [ -z "${frame[$scene]:-}" ]; then
        echo "no picture of $scene: there are ${!frame[*]}" >&2
        exit 2
    fi
    number=${frame[$scene]}
    out=out/gallery_$scene
    "$program" run "scenes/$scene.toml" --workers 2 --frames "$number" --out "$out" --overwrite
    "$program" render "$out" --frames "$number..$number" --size 480x360 --executor cpu --out "docs/pictures/$scene.png"
done
