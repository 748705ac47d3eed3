"""The fourteen classes, each with the parameters of its small and of its larger instance."""

SMALL_LARGE = [
    ("puzzles.py:Jugs", dict(size=3), dict(size=7)),
    ("puzzles.py:Vault", dict(doors=2, length=3), dict(doors=5, length=5)),
    ("puzzles.py:Frogs", dict(frogs=3), dict(frogs=5)),
    ("puzzles.py:Bridge", dict(people=4), dict(people=7)),
    ("puzzles.py:Crafting", dict(wood=3, stone=2), dict(wood=12, stone=8)),
    ("puzzles.py:Juggling", dict(height=5, balls=3), dict(height=9, balls=4)),
    ("supply.py:Reservoir", dict(level=6, seasons=4), dict(level=23, seasons=12)),
    ("supply.py:Junction", dict(room=2), dict(room=9)),
    ("supply.py:Battery", dict(charge=3, prices=6), dict(charge=23, prices=12)),
    ("supply.py:Sailing", dict(size=3), dict(size=7)),
    ("contests.py:Chomp", dict(rows=3, columns=4), dict(rows=4, columns=7)),
    ("contests.py:Ludo", dict(track=3), dict(track=6)),
    ("contests.py:Trial", dict(patients=4), dict(patients=8)),
    ("contests.py:Search", dict(drawers=3), dict(drawers=5)),
]
