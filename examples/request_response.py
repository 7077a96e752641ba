"""Service of one name on two nodes: a call uses the first response, so one node may stop.

python examples/request_response.py serve edge/proxy
python examples/request_response.py serve cloud/proxy
python examples/request_response.py call robot/proxy
"""

import sys

import gdp


def reverse(request: gdp.Request) -> bytes:
    """Return the payload from back to front."""
    return request.payload[::-1]


role, node = sys.argv[1:3]
with gdp.open(node) as session:
    if role == "serve":
        server = session.serve("reverse", reverse)
        print("serving", flush=True)
        server.serve_forever()
    for word in ("robot", "sensor", "planner") if role == "call" else ():
        response = session.call("reverse", word.encode(), timeout_s=10, replication="all")
        print(response.payload.decode(), "from", response.server.short, flush=True)
