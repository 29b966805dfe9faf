#!/bin/sh
# announce.sh PORT MASK: waits until the service is ready, then prints a request that works as it stands.
set -eu
address=http://127.0.0.1:$1
for _ in $(seq 120); do
    if python -c "import urllib.request as r; r.urlopen('$address/readyz', timeout=2)" 2>/dev/null; then
        printf '\nReady: open %s in a browser (interface: %s/docs). In another terminal, a mesh from three slices:\n\n' "$address" "$address"
        printf '  curl -fsS -H "Accept: application/x-ply" -F model=hippocampus -F mask=@%s -o mesh.ply %s/v1/reconstructions\n\n' "$2" "$address"
        exit 0
    fi
    sleep 0.5
done
echo "The service at $address did not become ready within a minute." >&2
