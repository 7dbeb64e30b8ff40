"""The controller in C: code generation, build, and the runtime that replaces Python's."""
