#!/bin/sh
# Takes secrets from files, as container platforms hand them out (NAME_FILE names the file of NAME), then becomes the
# command that was given.
set -eu

for name in AHOY_DATABASE_URL PREFECT_API_AUTH_STRING AWS_ACCESS_KEY_ID AWS_SECRET_ACCESS_KEY; do
    eval "file=\${${name}_FILE:-}"
    if [ -n "$file" ]; then
        value=$(cat "$file")
        export "$name=$value"
        unset "${name}_FILE"
    fi
done

# `ahoy server` takes its password from a file that only its owner can read.
if [ "${1:-} ${2:-}" = "ahoy server" ] && [ -n "${PREFECT_API_AUTH_STRING:-}" ]; then
    mkdir -p "$AHOY_SERVER"
    (umask 077 && printf '%s\n' "$PREFECT_API_AUTH_STRING" >"$AHOY_SERVER/auth")
fi

exec "$@"
