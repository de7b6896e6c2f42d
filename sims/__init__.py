"""Truth and readings for :mod:`magloc` and :mod:`adcs`: uses their models, never their estimators."""
