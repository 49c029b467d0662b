#!/bin/sh
# Gives the mounted folder to the user that the containers run as; Docker makes a missing one as root.
set -eu
folder=$1 user=$2 group=$3
owner=$(stat -c %u "$folder")
case $owner in
  "$user") ;;
  0) chown "$user:$group" "$folder" ;;
  *)
    # Somebody's own folder is not taken away from them.
    echo "prepare: the folder for results belongs to user $owner and the containers run as user $user;" \
      "start with SMAL_UID=$owner SMAL_GID=$(stat -c %g "$folder")" >&2
    exit 1
    ;;
esac
