"""Query paths, and write output files that appear either complete or not at all."""

import errno
import hashlib
import itertools
import json
import math
import os
import secrets
import stat
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeVar

from msgspec import ValidationError, convert

from splinecli.errors import InputError, OutputError, did_you_mean

UNFINISHED = ".splinecli-unfinished"  # suffix of hidden files that are being written
_MOST_JSON = 1 << 24  # size limit of JSON files in bytes


def free_name(name: str, is_taken: Callable[[str], bool], mark: str = "-") -> str:
    """Return the name, with a mark and a number from 2 on appended if it is taken."""
    numbered = (f"{name}{mark}{number}" for number in itertools.count(2))
    return next(each for each in itertools.chain([name], numbered) if not is_taken(each))


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's content as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def equal_files(paths: Sequence[Path]) -> list[tuple[int, int]]:
    """Return pairs of indices in `paths` of files with the same content: the first, and each later
    one.

    Only files of equal size are opened. Raises OSError.
    """
    sizes = [path.stat().st_size for path in paths]
    usual = Counter(sizes)
    alike = defaultdict(list)
    for place, (path, size) in enumerate(zip(paths, sizes, strict=True)):
        if usual[size] > 1:
            with path.open("rb") as file:
                file.seek(size // 2)  # the first rows of many images are black
                alike[size, file.read(1 << 12)].append(place)
    several = [place for places in alike.values() if len(places) > 1 for place in places]
    first: dict[str, int] = {}
    pairs = [(first.setdefault(file_sha256(paths[place]), place), place) for place in several]
    return [(one, other) for one, other in pairs if one != other]


def expanded(path: str) -> Path:
    """Return the path with ~ replaced by the home folder, if there is one."""
    return Path(os.path.expanduser(path))  # noqa: PTH111 - Path.expanduser raises for an unknown user


def utf8_name(path: Path, file: IO[bytes]) -> str:
    """Return a path of an open file for a C library.

    If the name is not UTF-8, on which some libraries crash, another path of the file is returned.
    """
    name = str(path.absolute())
    try:
        name.encode()
    except UnicodeEncodeError:
        return f"/dev/fd/{file.fileno()}"
    return name


def create_hidden(folder: Path) -> IO[bytes]:
    """Return a new hidden file with a random name in the folder, open for writing. Raises
    OSError.
    """
    # With mode x, neither an existing file is opened nor a link followed.
    return (folder / f".{secrets.token_hex(8)}{UNFINISHED}").open("xb")


@contextmanager
def made_folder(folder: Path) -> Iterator[list[Path]]:
    """Create a folder, and yield the created folders, including parents. Empty ones are removed at
    the end.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield made
    finally:
        with suppress(OSError):
            for place in made:
                place.rmdir()


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Yield a new file that replaces `path` after the block, so that it is complete or does not
    appear.

    It is written to the same folder and renamed, which replaces a link instead of following it.
    Folders are created as needed. Raises OutputError.
    """
    temporary: Path | None = None
    with refusals_as_output_errors(path), made_folder(path.parent) as made:
        try:
            with create_hidden(path.parent) as file:
                temporary = Path(file.name)
                yield file
            sync(temporary)
            temporary.replace(path)
            sync_names(path.parent, *made)
        finally:
            if temporary is not None:  # also on Ctrl-C
                temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file in the same way as `replacing`. Raises OutputError."""
    with replacing(path) as file:
        file.write(content)


def sync(path: Path) -> None:
    """Wait until the content of a file, or the names in a folder, are on the disk. Raises
    OSError.
    """
    windows = os.name == "nt"
    if windows and path.is_dir():  # Windows cannot open folders
        return
    handle = os.open(path, os.O_RDWR if windows else os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some network drives cannot sync
            raise
    finally:
        os.close(handle)


def sync_names(folder: Path, *made: Path) -> None:
    """Wait until the names in a folder and in new folders are on the disk. Raises OSError."""
    for place in dict.fromkeys((folder, *(new.parent for new in made))):
        sync(place)


Value = TypeVar("Value")


def parse_json(text: str | bytes, kind: type[Value] | Any = Any) -> Value | Any:
    """Return the value of a JSON text, optionally as a record of this kind.

    Raises ValueError, also if the text is deeply nested, if a number is not finite or exceeds the
    range of floats, or if the value does not match the kind.
    """

    def whole_number(digits: str) -> int:
        if len(digits) > 300:  # shorter numbers are within the range of floats
            raise ValueError(f"a number has {len(digits)} digits")
        return int(digits)

    def finite_number(digits: str) -> float:
        if not math.isfinite(number := float(digits)):
            raise ValueError(f"the number {digits[:40]} is not finite")
        return number

    try:
        read = json.loads(
            text, parse_int=whole_number, parse_float=finite_number, parse_constant=finite_number
        )
        return convert(read, kind)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except ValidationError as error:
        raise ValueError(str(error)) from None


def is_special(path: Path) -> bool:
    """Return whether the path exists but is not a file, such as a device, which might never end."""
    return path.exists() and not path.is_file()


def read_json(path: Path, kind: type[Value] | Any = Any) -> Value | Any:
    """Return the value of a JSON file.

    Raises OSError, or ValueError as in parse_json and if it is not a file.
    """
    if is_special(path):
        raise ValueError("it is not a file")
    if path.stat().st_size > _MOST_JSON:
        raise ValueError(f"it is larger than {_MOST_JSON / 1e6:.0f} MB")
    return parse_json(path.read_text("utf-8"), kind)


class NoRoomError(OutputError):
    """The disk is full or read-only. A batch ends, because other folders would fail, too."""


_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@contextmanager
def refusals_as_output_errors(path: Path) -> Iterator[None]:
    """Convert an OSError inside the context to an OutputError with the path."""
    try:
        yield
    except OSError as error:
        # NumPy's errors only state how much was written.
        reason = error.strerror or f"{error}; the disk may be full"
        kind = NoRoomError if error.errno in (None, *_NO_ROOM) else OutputError
        raise kind(
            f"cannot be written ({reason})", path, hint="Choose another place with -o"
        ) from error


def as_splinecli_error(error: OSError, path: Path | None = None) -> InputError | NoRoomError:
    """Return splinecli's error for an OSError that usually means that a file cannot be read.

    `path` is used if the error does not name a file.
    """
    if error.errno in _NO_ROOM:
        return NoRoomError(f"cannot be written ({error.strerror})", error.filename or path)
    return InputError(f"cannot be read ({error.strerror or error})", error.filename or path)


def check_writable(folder: Path) -> None:
    """Raise OutputError unless a folder exists or can be created, and files can be written to
    it.
    """
    place = folder
    try:
        while not place.exists():
            place = place.parent
    except OSError as error:
        raise OutputError(f"cannot be a folder ({error.strerror})", folder) from error
    hint = "Choose another place with -o"
    if not place.is_dir():
        raise OutputError("found a file, expected a folder for the results", place, hint=hint)
    if not os.access(place, os.W_OK | os.X_OK):
        raise OutputError("no permission to write to this folder", place, hint=hint)


def check_free(folder: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Raise OutputError as check_writable does, or if a file exists already and `overwrite` is
    false.
    """
    check_writable(folder)
    for name in () if overwrite else names:
        if (folder / name).exists():
            raise OutputError(
                f"{name} already exists in this folder",
                folder,
                hint="Add --overwrite, or choose another place with -o",
            )


def write_text(path: Path, content: str) -> None:
    """Write UTF-8 text in the same way as write_bytes.

    Characters of file names that are not valid text are escaped.
    """
    write_bytes(path, content.encode(errors="backslashreplace"))


_KINDS = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
StrPath = str | os.PathLike[str]  # a path in any form accepted by the standard library


def find_mode(path: Path) -> int | None:
    """Return the mode of a path (see stat), following links, or None if it does not exist.

    Raises InputError.
    """
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise _unreadable(path, error.strerror) from None
    except ValueError:
        raise _unreadable(path, "a zero byte in its name") from None


def check_file(
    path: Path, expected: str, *, pipe: bool = False, words: Collection[str] = ()
) -> None:
    """Raise InputError unless the path is a file. A device, for example, might never end.

    With `pipe`, process substitution of the shell, `<(...)`, is also accepted; see is_substitution.
    `words` are those that an option accepts instead of a file, for the hint.
    """
    mode = find_mode(path)
    if mode is None:
        raise InputError("the file does not exist", path, hint=did_you_mean(path, words))
    if not (stat.S_ISREG(mode) or (pipe and is_substitution(path))):
        raise InputError(
            f"found {_KINDS.get(stat.S_IFMT(mode), 'a device')}, expected {expected}", path
        )


@contextmanager
def reading(path: Path, kind: str = "file") -> Iterator[None]:
    """Convert a system error while a file is read to an InputError with its path."""
    try:
        yield
    except OSError as error:
        raise InputError(f"the {kind} cannot be read ({error.strerror})", path) from None


def is_found_file(path: Path) -> bool:
    """Return whether an entry of a folder is a file, and False for a folder.

    Raises InputError for anything else, such as a pipe or a broken link, because skipping it would
    hide the problem.
    """
    if is_folder(path):
        return False
    check_file(path, "a file")
    return True


def is_substitution(path: Path) -> bool:
    """Return whether the path is a pipe opened by the shell: process substitution or standard
    input.
    """
    try:
        opened = str(path).startswith(("/dev/fd/", "/proc/self/fd/", "/dev/stdin"))
        return opened and stat.S_ISFIFO(path.stat().st_mode)
    except (OSError, ValueError):
        return False


def is_folder(path: Path) -> bool:
    """Return whether a folder exists, or False if the system does not answer."""
    return os.path.isdir(path)  # noqa: PTH112 - Path.is_dir raises for a name that is too long


def resolve(path: Path) -> Path:
    """Return the path without links and "..". Raises InputError if the system cannot resolve it."""
    try:
        return path.resolve()
    except RuntimeError:  # for a loop of links, before Python 3.13
        raise _unreadable(path, os.strerror(errno.ELOOP)) from None
    except OSError as error:
        raise _unreadable(path, error.strerror) from None


def _unreadable(path: Path, reason: str | None) -> InputError:
    return InputError(f"cannot be read ({reason})", path)
