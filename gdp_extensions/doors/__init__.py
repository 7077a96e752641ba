"""Doors: WebSocket servers through which programs of other systems read and write names of the overlay.

A door is an endpoint of the bridge, as ``proxy/endpoints/ros2`` is: its graph consists of WebSocket clients.
"""
