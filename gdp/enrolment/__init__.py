"""Enrolment over the internet: tokens, the enrolment server of a domain, and the agent of each member.

I/O. A machine joins with a token, over TLS 1.3. Afterwards its agent keeps a connection to the server: it renews
memberships, and receives endpoint records and mail.
"""
