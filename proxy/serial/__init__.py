"""ROS messages as JSON, CBOR or their own bytes, and back, without a generated message class anywhere.

Place: pure. A channel (``channel``) brings its definition; ``schema`` reads it into a tree of types; ``reader`` and
``writer`` compile that tree once into steps that walk a message; a dialect (``json_dialect``, ``cbor_dialect``,
``native_dialect``) says how a leaf looks; ``serializer`` puts them together. The conventions of the two readable
encodings are in ``docs/reference/serialisation.md``.
"""
