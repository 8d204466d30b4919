"""Read and overwrite a file that another jail keeps in its scratch folder."""


def attack(paths, text):
    found = []
    for path in paths:
        try:
            with open(path) as file:
                found.append(file.read())
        except OSError as error:
            found.append(str(error))
        try:
            with open(path, "w") as file:
                file.write(text)
        except OSError as error:
            found.append(str(error))
    return found
