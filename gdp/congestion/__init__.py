"""Congestion control of one path: how many bytes may be under way, and when the next frame may leave.

Sans-I/O. ``controller.py`` decides, ``states.py`` is its table, ``path_model.py`` measures by ``delivery_rate.py``,
``pacer.py`` delays frames, ``cubic.py`` is the window in competition with TCP.
"""
