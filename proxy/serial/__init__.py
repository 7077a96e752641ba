"""Serialisation of ROS messages as JSON, CBOR or their own bytes, and back, without any generated message class.

Sans-I/O. A channel (``channel``) carries its definition; ``schema`` reads it into a tree of types. ``reader`` and
``writer`` compile that tree once into steps that traverse a message. A dialect (``json_dialect``, ``cbor_dialect``,
``native_dialect``) determines the form of a leaf; ``serializer`` combines them. The conventions of the two readable
encodings are in ``docs/reference/serialisation.md``.
"""
