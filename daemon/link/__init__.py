"""The vehicle link: MAVLink messages in, typed events out.

:mod:`message` takes messages from MAVSDK or pymavlink, :mod:`decode` holds the one table from
message to event, :mod:`triggers` and :mod:`progress` count what vehicles report twice or not at
all, :mod:`clock` relates the vehicle's clock to others. Nothing here opens a connection.
"""
