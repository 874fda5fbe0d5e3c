"""A local process that holds no token: reads ports from standard input, and calls what listens there.

Prints a JSON object: for each port, the answer to each call. It asks for what would run code, and for what would tell.
"""

import http.client
import json
import sys

import grpc  # type: ignore[import-untyped]

RUNS = json.dumps({"entrypoint": sys.argv[1]})
GRPC_CALLS = (
    "/ray.rpc.NodeInfoGcsService/GetAllNodeInfo",
    "/ray.rpc.InternalKVGcsService/InternalKVKeys",
    "/ray.rpc.NodeManagerService/GetNodeStats",
    "/ray.rpc.ObjectManagerService/Pull",
    "/ray.rpc.CoreWorkerService/GetCoreWorkerStats",
)
HTTP_CALLS = ("/api/job_agent/jobs/", "/get_runtime_envs_info")


def call_http(port: int, path: str) -> str:
    """The status, or what went wrong."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    try:
        connection.request("POST", path, RUNS, {"Content-Type": "application/json"})
        return str(connection.getresponse().status)
    except (OSError, http.client.HTTPException) as error:
        return type(error).__name__
    finally:
        connection.close()


def call_grpc(port: int, method: str) -> str:
    """The name of gRPC's status code."""
    with grpc.insecure_channel(f"127.0.0.1:{port}", [("grpc.enable_http_proxy", 0)]) as channel:
        try:
            channel.unary_unary(method)(b"", timeout=5)
        except grpc.RpcError as error:
            return error.code().name
        return "OK"


if __name__ == "__main__":
    print(
        json.dumps(
            {
                port: {path: call_http(port, path) for path in HTTP_CALLS}
                | {method: call_grpc(port, method) for method in GRPC_CALLS}
                for port in json.loads(sys.stdin.readline())
            }
        )
    )
