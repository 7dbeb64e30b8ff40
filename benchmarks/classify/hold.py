"""Six objects held for ten seconds by a fluid-filled finger: pairs of holds left out, with and without the level.

    python benchmarks/classify/hold.py FOLDER [--classifiers A,B] [--out F.json]

FOLDER holds ``OBJECT_NUMBER_TRIAL_HOLD.mat`` of github joshsia/haptics-classification (``data/``), read by
``thermogrip.datasets.public_sets``.  The data are not part of this package.

The rule, written down before the first look at a trace.  Each object was held ten times in a row.  Holds 1
and 2 of every object are left out together, then 3 and 4, and so on: five folds of 48 holds that train and 12
that test, all 60 tested once.  Two holds in turn are alike, so no hold is tested beside its partner.
Temperature of finger 0 alone, all samples of it.  Everything is chosen within the 48; the classifiers are
those of ``make_classifier`` with their defaults, and nothing in them is chosen with these holds in view.
Ten in a row of one object also means that the level from which the finger starts tells the object: so
all is scored twice, as published, and with each trace less its first 0.1 s.  The second is the one that
says something about touch.  Beside both stands the leak probe, which is given nothing but that level.
"""
