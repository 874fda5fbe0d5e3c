"""The part of the S3 protocol that a dataset uses, served from memory on this machine; it can be made to fail."""

import hashlib
import random
import socket
import struct
import threading
import time
import urllib.parse
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Literal
from xml.sax.saxutils import escape

from obstore.store import S3Store

_DATE = "Sat, 21 Nov 2026 10:00:00 GMT"
_ISO = "2026-11-21T10:00:00.000Z"

Fault = Literal["500", "503", "503 when done", "reset", "reset when done", "silence"]
FAULTS: tuple[Fault, ...] = ("500", "503", "503 when done", "reset", "reset when done", "silence")


class Bucket:
    """What the server holds, and how it behaves."""

    def __init__(self, conditional: Literal["kept", "ignored", "refused"] = "kept") -> None:
        self.objects: dict[str, bytes] = {}
        self.uploads: dict[str, dict[int, bytes]] = {}
        self.conditional = conditional
        """What becomes of a condition on a put: a store may not know of it, or answer that it is not implemented."""
        self.share = 0.0
        """The share of requests that meet one of `faults`."""
        self.faults: tuple[Fault, ...] = FAULTS
        self.chance = random.Random(1)
        self.delay_s = 0.0
        self.quota: int | None = None
        """Bytes that fit; a put beyond them is refused."""
        self.requests: Counter[str] = Counter()
        """By method, and under `fault` those that met one."""
        self.puts: Counter[str] = Counter()
        """By key: how often it was written."""
        self.most_at_once = 0
        self._at_once = 0
        self.lock = threading.RLock()

    @contextmanager
    def counted(self, method: str, key: str) -> Iterator[Fault | None]:
        """Counts a request; yields the fault that it meets."""
        with self.lock:
            self.requests[method] += 1
            self._at_once += 1
            self.most_at_once = max(self.most_at_once, self._at_once)
            fault = self.chance.choice(self.faults) if self.chance.random() < self.share else None
            self.requests["fault"] += fault is not None
        try:
            time.sleep(self.delay_s)
            yield fault
        finally:
            with self.lock:
                self._at_once -= 1

    def store(self, key: str, data: bytes) -> bool:
        """Puts an object; False where it does not fit."""
        others = sum(len(value) for name, value in self.objects.items() if name != key)
        if self.quota is not None and others + len(data) > self.quota:
            return False
        self.objects[key] = data
        self.puts[key] += 1
        return True


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    wbufsize = 1 << 16  # one packet for each answer
    bucket: Bucket
    silence_s: float

    def log_message(self, format, *arguments) -> None:
        pass

    def _serve(self) -> None:
        """Does what was asked, unless a fault comes before or after."""
        act = {"PUT": self._put, "GET": self._get, "HEAD": self._get, "DELETE": self._delete, "POST": self._post}
        data = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        with self.bucket.counted(self.command, self._key()) as fault:
            self._dropped = fault is not None and fault.endswith("when done")
            if fault is None or self._dropped:
                act[self.command](data)
        if fault in ("500", "503", "503 when done"):
            self._dropped = False
            self._error(int(fault[:3]), "SlowDown")
        elif fault is not None:
            if fault == "silence":
                time.sleep(self.silence_s)
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            self.close_connection = True

    do_PUT = do_GET = do_HEAD = do_DELETE = do_POST = _serve

    def _key(self) -> str:
        return urllib.parse.unquote(urllib.parse.urlsplit(self.path).path).split("/", 2)[-1]

    def _query(self) -> dict[str, str]:
        return dict(urllib.parse.parse_qsl(urllib.parse.urlsplit(self.path).query, keep_blank_values=True))

    def _answer(self, status: int, body: bytes = b"", **headers: str) -> None:
        if self._dropped:
            return
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _error(self, status: int, code: str) -> None:
        self._answer(status, f"<Error><Code>{code}</Code><Message>{code}</Message></Error>".encode())

    def _put(self, data: bytes) -> None:
        key, bucket, query = self._key(), self.bucket, self._query()
        with bucket.lock:
            if source := self.headers.get("x-amz-copy-source"):
                return self._copy(urllib.parse.unquote(source).lstrip("/").split("/", 1)[1], key)
            if part := query.get("partNumber"):
                bucket.uploads[query["uploadId"]][int(part)] = data
                return self._answer(200, ETag=f'"{part}"')
            if self.headers.get("If-None-Match") == "*":
                if bucket.conditional == "refused":
                    return self._error(501, "NotImplemented")
                if bucket.conditional == "kept" and key in bucket.objects:
                    return self._error(412, "PreconditionFailed")
            found = _tag(bucket.objects[key]) if key in bucket.objects else ""
            if bucket.conditional == "kept" and self.headers.get("If-Match", found) != found:
                return self._error(412, "PreconditionFailed")
            if not bucket.store(key, data):
                return self._error(403, "QuotaExceeded")
        return self._answer(200, ETag=_tag(data))

    def _copy(self, source: str, key: str) -> None:
        data = self.bucket.objects.get(source)
        if data is None:
            return self._error(404, "NoSuchKey")
        if not self.bucket.store(key, data):
            return self._error(403, "QuotaExceeded")
        body = f"<CopyObjectResult><ETag>{_tag(data)}</ETag><LastModified>{_ISO}</LastModified></CopyObjectResult>"
        return self._answer(200, body.encode())

    def _get(self, _: bytes) -> None:
        query = self._query()
        if "list-type" in query:
            return self._answer(200, self._listing(query.get("prefix", ""), query.get("delimiter")))
        data = self.bucket.objects.get(self._key())
        if data is None:
            return self._error(404, "NoSuchKey")
        return self._answer(200, data, Last_Modified=_DATE, ETag=_tag(data))

    def _delete(self, _: bytes) -> None:
        with self.bucket.lock:
            self.bucket.objects.pop(self._key(), None)
            self.bucket.uploads.pop(self._query().get("uploadId", ""), None)
        self._answer(204)

    def _post(self, data: bytes) -> None:
        """Begins or ends an upload in parts, or deletes many objects."""
        key, bucket, query = self._key(), self.bucket, self._query()
        with bucket.lock:
            if "uploads" in query:
                name = f"upload-{len(bucket.uploads)}-{bucket.requests['POST']}"
                bucket.uploads[name] = {}
                tags = f"<Bucket>bucket</Bucket><Key>{escape(key)}</Key><UploadId>{name}</UploadId>"
                body = f"<InitiateMultipartUploadResult>{tags}</InitiateMultipartUploadResult>"
            elif "uploadId" in query:
                parts = bucket.uploads.pop(query["uploadId"], None)
                if parts is None:
                    return self._error(404, "NoSuchUpload")
                bucket.store(key, b"".join(parts[number] for number in sorted(parts)))
                tags = f'<Key>{escape(key)}</Key><ETag>"0"</ETag>'
                body = f"<CompleteMultipartUploadResult>{tags}</CompleteMultipartUploadResult>"
            else:
                keys = [part.split("</Key>")[0] for part in data.decode().split("<Key>")[1:]]
                for one in keys:
                    bucket.objects.pop(one, None)
                deleted = "".join(f"<Deleted><Key>{one}</Key></Deleted>" for one in keys)
                body = f"<DeleteResult>{deleted}</DeleteResult>"
        self._answer(200, body.encode())

    def _listing(self, prefix: str, delimiter: str | None) -> bytes:
        keys, folders = [], set()
        with self.bucket.lock:
            for key, data in sorted(self.bucket.objects.items()):
                rest = key.removeprefix(prefix)
                if not key.startswith(prefix):
                    continue
                if delimiter and delimiter in rest:
                    folders.add(prefix + rest.split(delimiter)[0] + delimiter)
                else:
                    keys.append((key, data))
        contents = "".join(
            f"<Contents><Key>{escape(key)}</Key><Size>{len(data)}</Size><LastModified>{_ISO}</LastModified>"
            f"<ETag>{_tag(data)}</ETag></Contents>"
            for key, data in keys
        )
        common = "".join(f"<CommonPrefixes><Prefix>{escape(one)}</Prefix></CommonPrefixes>" for one in sorted(folders))
        return f"<ListBucketResult><IsTruncated>false</IsTruncated>{contents}{common}</ListBucketResult>".encode()


def _tag(data: bytes) -> str:
    return f'"{hashlib.md5(data).hexdigest()}"'


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 128

    def handle_error(self, request, client_address) -> None:
        """A client that gave up is no news."""


@contextmanager
def s3_server(bucket: Bucket, timeout_s: float = 30.0) -> Iterator[S3Store]:
    """A client of a server that holds `bucket`; it waits so long for an answer, and a fault of silence is longer."""
    handler = type("Handler", (_Handler,), {"bucket": bucket, "silence_s": timeout_s + 0.5})
    server = _Server(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield S3Store(
            "bucket",
            endpoint=f"http://127.0.0.1:{server.server_port}",
            region="us-east-1",
            skip_signature=True,
            client_options={"allow_http": True, "timeout": f"{timeout_s}s"},
        )
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
