"""The environment of a private Ray: it listens on loopback alone, and answers who shows its token."""

import secrets


def private_environment() -> dict[str, str]:
    """The variables that every process of one private Ray starts with; each call makes a new token."""
    return {
        # Who does not show the token is refused. The mode is said outright: left open, Ray takes a token from the home
        # folder, or leaves one there; and another variable could have it ask Kubernetes who the caller is.
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_ENABLE_K8S_TOKEN_AUTH": "false",
        # No cluster, so this node's address is loopback, and every process binds to that. Otherwise Ray replaces
        # 127.0.0.1 by the machine's own address, and most of its processes listen on all of them.
        "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
        "RAY_USAGE_STATS_ENABLED": "0",
        # A GCS of this machine that is gone does not come back, as a cluster's may: its clients end after this time, which
        # is 60 s otherwise. So do the agents of a Ray whose other processes were killed.
        "RAY_gcs_rpc_server_reconnect_timeout_s": "15",
    }


NOT_INHERITED = ("RAY_REDIS_ADDRESS",)
"""Variables of the user's that would tie a private Ray to another one."""
