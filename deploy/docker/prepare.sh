#!/bin/sh
# Gives the mounted folder to the user of the containers; Docker creates a missing folder as root.
set -eu
folder=$1 user=$2 group=$3
owner=$(stat -c %u "$folder")
case $owner in
  "$user") ;;
  0) chown "$user:$group" "$folder" ;;
  *)
    # The folder of another user keeps its owner.
    echo "prepare: the folder for results belongs to user $owner, but the containers run as user $user;" \
      "start with SMAL_UID=$owner SMAL_GID=$(stat -c %g "$folder")" >&2
    exit 1
    ;;
esac
