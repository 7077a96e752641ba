"""Laboratory of networks across an internet: sites behind NATs and firewalls, in namespaces of one machine.

``access`` says what each kind of site lets through, and writes the nftables text of its router; ``laboratory``,
``site`` and ``host`` make the namespaces; ``overlay`` joins hosts to a domain; ``flow`` counts messages.
"""
