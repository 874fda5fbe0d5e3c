"""The part of the S3 protocol that a dataset uses, served from memory on this machine."""

import hashlib
import threading
import urllib.parse
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from xml.sax.saxutils import escape

from obstore.store import S3Store

_DATE = "Sat, 21 Nov 2026 10:00:00 GMT"
_ISO = "2026-11-21T10:00:00.000Z"


class Bucket:
    """What the server holds, and how it behaves."""

    def __init__(self, conditional: bool = True) -> None:
        self.objects: dict[str, bytes] = {}
        self.conditional = conditional
        """False: a condition on a put is ignored, as by stores that do not know of it."""
        self.lose_answers_of = ""
        """The first put of a key with this in it is done, and answered with an error."""
        self.lock = threading.Lock()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    wbufsize = 1 << 16  # one packet for each answer
    bucket: Bucket

    def log_message(self, format, *arguments) -> None:
        pass

    def _key(self) -> str:
        return urllib.parse.unquote(urllib.parse.urlsplit(self.path).path).split("/", 2)[-1]

    def _answer(self, status: int, body: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_PUT(self) -> None:
        data = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        key, bucket = self._key(), self.bucket
        with bucket.lock:
            if source := self.headers.get("x-amz-copy-source"):
                name = urllib.parse.unquote(source).lstrip("/").split("/", 1)[1]
                if name not in bucket.objects:
                    return self._answer(404, b"<Error><Code>NoSuchKey</Code></Error>")
                bucket.objects[key] = bucket.objects[name]
                tag = hashlib.md5(bucket.objects[key]).hexdigest()
                body = f'<CopyObjectResult><ETag>"{tag}"</ETag><LastModified>{_ISO}</LastModified></CopyObjectResult>'
                return self._answer(200, body.encode())
            if bucket.conditional and self.headers.get("If-None-Match") == "*" and key in bucket.objects:
                return self._answer(412, b"<Error><Code>PreconditionFailed</Code></Error>")
            bucket.objects[key] = data
            if bucket.lose_answers_of and bucket.lose_answers_of in key:
                bucket.lose_answers_of = ""
                return self._answer(503, b"<Error><Code>SlowDown</Code></Error>")
        return self._answer(200, ETag=f'"{hashlib.md5(data).hexdigest()}"')

    def do_GET(self) -> None:
        split = urllib.parse.urlsplit(self.path)
        query = dict(urllib.parse.parse_qsl(split.query))
        if "list-type" in query:
            return self._answer(200, self._listing(query.get("prefix", ""), query.get("delimiter")))
        data = self.bucket.objects.get(self._key())
        if data is None:
            return self._answer(404, b"<Error><Code>NoSuchKey</Code></Error>")
        return self._answer(200, data, Last_Modified=_DATE, ETag=f'"{hashlib.md5(data).hexdigest()}"')

    do_HEAD = do_GET

    def do_DELETE(self) -> None:
        with self.bucket.lock:
            self.bucket.objects.pop(self._key(), None)
        self._answer(204)

    def do_POST(self) -> None:
        """Deletes many."""
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        keys = [part.split("</Key>")[0] for part in body.split("<Key>")[1:]]
        with self.bucket.lock:
            for key in keys:
                self.bucket.objects.pop(key, None)
        deleted = "".join(f"<Deleted><Key>{key}</Key></Deleted>" for key in keys)
        self._answer(200, f"<DeleteResult>{deleted}</DeleteResult>".encode())

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
                    keys.append((key, len(data)))
        contents = "".join(
            f"<Contents><Key>{escape(key)}</Key><Size>{size}</Size><LastModified>{_ISO}</LastModified>"
            f'<ETag>"0"</ETag></Contents>'
            for key, size in keys
        )
        common = "".join(
            f"<CommonPrefixes><Prefix>{escape(folder)}</Prefix></CommonPrefixes>" for folder in sorted(folders)
        )
        return f"<ListBucketResult><IsTruncated>false</IsTruncated>{contents}{common}</ListBucketResult>".encode()


@contextmanager
def s3_server(bucket: Bucket) -> Iterator[S3Store]:
    """A client of a server that holds `bucket`."""
    handler = type("Handler", (_Handler,), {"bucket": bucket})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield S3Store(
            "bucket",
            endpoint=f"http://127.0.0.1:{server.server_port}",
            region="us-east-1",
            skip_signature=True,
            client_options={"allow_http": True},
        )
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
