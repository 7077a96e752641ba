"""Software that ``fog`` sends to rented machines: wheels, and the user's workspace, each with its SHA-256.

``manifest`` lists files and their hashes; ``offer`` reads the files of a site; ``server`` serves them to machines;
``fetch`` runs on the machine; ``wheels`` builds them.
"""
