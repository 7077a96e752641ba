"""Publisher of ten greetings a second, and a subscriber that prints them.

python examples/publish_subscribe.py publish robot/proxy
python examples/publish_subscribe.py subscribe server/proxy
"""

import sys
import time

import gdp

role, node = sys.argv[1:3]
with gdp.open(node) as session:
    if role == "publish":
        publisher = session.publisher("greeting")
        publisher.wait_for_readers()
        for number in range(10):
            publisher.put(f"hello {number}".encode())
            time.sleep(0.1)
        publisher.flush(timeout_s=5)
    else:
        for message in session.subscribe("greeting"):
            print(message.number, message.payload.decode(), "from", message.publisher.short, flush=True)
            if message.number == 10:
                break
