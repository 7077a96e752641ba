"""The ring command: five switches in namespaces, a recording sent through them, compared byte for byte.

Place: shell, above everything; it starts the commands that stand alone and reads what they print.
"""
