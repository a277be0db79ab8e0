"""What every training of a network needs: checkpoints, and runs that can be taken up."""
