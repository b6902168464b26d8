"""What the readers' inputs have in common."""

from pathlib import Path

from tools.fuzz.corpus import Corpus


class Inputs:
    """Makes inputs in a folder, and reads them; mark: a file that hostile input would write.

    A reader is a method with a random generator. It returns where what it read is whole, raises InputError where the
    input is refused, and Garbage where it was read as something that it is not.
    """

    def __init__(self, corpus: Corpus, folder: Path) -> None:
        self.corpus, self.folder, self.mark = corpus, folder, str(folder / "mark")

    def file(self, name: str, content: bytes | str) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path
