"""Live status for any machine: topics over zenoh, and the fleet as one looks at it from outside.

``schemas`` what is said, ``topics`` on which keys and how often, ``settings`` how machines find each
other, ``bus`` the daemon's side, ``fleet`` the other one, ``commands`` what may be asked of a daemon.
zenoh is imported nowhere else.
"""
