"""Session library for programs without ROS: sessions publish, subscribe, serve and call 256-bit names.

I/O, above ``gdp.nodes``. A program uses it through ``import gdp``; ``docs/tutorials/library.md`` shows how.

One core has two drivers: ``core.py`` (sans-I/O) connects a participant with queues and calls. ``driver.py`` runs it for
threads, ``loop_driver.py`` for asyncio.
"""
