"""The ``bag`` endpoint: recordings in, recordings out.

Place: I/O. The halves are in ``bag_reader`` and ``bag_writer``.
"""

from proxy.endpoints.bag_limits import BagLimits
from proxy.endpoints.bag_process import RecordingError
from proxy.endpoints.bag_reader import BagReader
from proxy.endpoints.bag_source import Message
from proxy.endpoints.bag_writer import BagWriter

__all__ = ["BagLimits", "BagReader", "BagWriter", "Message", "RecordingError"]
