"""Have another process killed first when memory runs out."""


def attack(pid, score):
    with open(f"/proc/{pid}/oom_score_adj", "w") as file:
        file.write(str(score))
