"""Publisher of 30 images a second, and a subscriber that shows their arrival: camera.py send|show NODE."""

import asyncio
import os
import sys
import time

import gdp


async def main(role: str, node: str, count: int = 30) -> None:
    """Send or show ``count`` images of 640 x 480 pixels."""
    async with gdp.open_async(node) as session:
        if role == "send":
            camera = session.publisher("camera", reliable=False)  # a late image has no value
            await camera.wait_for_readers()
            for _ in range(count):
                await camera.put(os.urandom(640 * 480))
                await asyncio.sleep(1 / 30)
        else:
            async for image in session.subscribe("camera", queue=2):  # a slow program sees the newest two
                late_ms = 1e3 * (time.time() - image.stamp)
                print(f"image {image.number}: {len(image.payload)} bytes, {late_ms:.1f} ms", flush=True)
                if image.number >= count:
                    break


asyncio.run(main(sys.argv[1], sys.argv[2]))
