"""The verbs of the command line, one module for each part of the way through.

Every function here takes parsed options, calls a room, prints what people need and returns the exit code (0
done, 3 done but the answer is no).  Rooms are imported inside the functions: ``--help`` loads none of them.
"""
