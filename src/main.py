"""The entry point of the paper: ``python src/main.py algorithm=sac env=FetchReach-v4``."""

from scilab_rl.cli.main import main

if __name__ == "__main__":  # subprocess environments import this file again
    main()
