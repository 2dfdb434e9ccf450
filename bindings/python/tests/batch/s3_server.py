"""A server of S3 on loopback:  python s3_server.py [PORT]

moto's server looks at a condition and writes in two steps; two puts of one object can then both
win. One request at a time makes its puts atomic, as those of S3 are.
"""

import sys
import threading
from contextlib import contextmanager


def application():
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app

    app = DomainDispatcherApplication(create_backend_app)
    lock = threading.Lock()

    def locked(environ, start_response):
        with lock:
            return list(app(environ, start_response))

    return locked


def make(port=0):
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log(self, *_):
            pass

    return make_server("127.0.0.1", port, application(), threaded=True, request_handler=Quiet)


def environment(port):
    return {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }


@contextmanager
def served():
    """The environment of clients."""
    server = make()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield environment(server.port)
    server.shutdown()


if __name__ == "__main__":
    make(int(sys.argv[1]) if len(sys.argv) > 1 else 0).serve_forever()
