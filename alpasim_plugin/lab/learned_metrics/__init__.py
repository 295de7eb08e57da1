"""What is measured through judges and by classical trackers: lanes, cuboids, Frechet distances, motion (docs/lab/judges.md). No torch here."""
