"""The library for programs without ROS: sessions that publish, subscribe, serve and call by 256-bit names.

Layer: I/O, above ``gdp.nodes``. A program uses it through ``import gdp``; ``docs/tutorials/library.md`` shows how.

One core, two drivers: ``core.py`` (sans-I/O) connects a member of the overlay with queues and calls. ``driver.py`` runs
it for threads, ``loop_driver.py`` for asyncio.
"""
