"""`python -m nerfcli`: the program, where the command is not on the path."""

from nerfcli.cli import main

main()
