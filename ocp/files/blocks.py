"""Blocks of G-code: the words of a line, its comments and numbers of no meaning left out.

RS274/NGC as of the LinuxCNC manual, "G-Code Overview": letters of either case, blanks anywhere, `( )` and `;` comments,
block delete `/`, line numbers N, files between two lines of `%`. A program number `O1000` alone in its line is passed
over; parameters, expressions and control words are refused, for what they come to depends on the machine.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from models.input_files import INPUT_LIMITS
from ocp.files.lines import FileName, wrong_line

__all__ = ["Block", "blocks"]

WORD = re.compile(r"([A-Z])([+-]?(?:\d+\.?\d*|\.\d+))")
COMMENT = re.compile(r"\([^()]*\)")
DELETED = re.compile(r"^/\d*")
CHECKSUM = re.compile(r"\*\d+$")
EXPONENT = re.compile(r"[\d.]E[+-]?\d+(?![\d.])", re.IGNORECASE)
CONTROL, PROGRAM_NUMBER = re.compile(r"(N\d+)?O[\d<]"), re.compile(r"(N\d+)?O\d+")
NOT_RUN = "O-words (subroutines, loops, conditions) are not run; post the program without them"


class Block(NamedTuple):
    """The words of one line.

    Attributes:
        number: Of the line in the file, from 1.
        text: The line as it stands.
        codes: G and M words in tenths: ("G", 901) is G90.1.
        words: All others by their letter.
        skipped: Whether the line begins with `/`.
    """

    number: int
    text: str
    codes: tuple[tuple[str, int], ...]
    words: dict[str, float]
    skipped: bool


def blocks(file: FileName, lines: Sequence[str]) -> Iterator[Block]:
    """Blocks with words in them, up to the second `%`.

    Raises:
        ProblemError: By line: what is no word, a comment without an end, an expression, a word given twice.
    """
    inside = False
    for number, text in enumerate(lines, 1):
        line = text
        if "(" in line or ")" in line or ";" in line:
            line = _without_comments(file, number, text)
        words = line.upper().split()
        if not words:
            continue
        if words[0][0] == "%":
            if inside:
                return
            inside = True
            continue
        inside = True  # a lone % after words ends the program, too
        if ("E" in line or "e" in line) and (exponent := EXPONENT.search(line)):
            raise wrong_line(file, number, text, f"{exponent[0]!r} is no number of G-code; write it without E")
        line = "".join(words)
        skipped = line[0] == "/"
        line = DELETED.sub("", line) if skipped else line
        if "*" in line:
            line = CHECKSUM.sub("", line)
        found_words = WORD.findall(line)
        if sum(len(letter) + len(value) for letter, value in found_words) != len(line):
            _refuse(file, number, text, line)
        codes, values = [], {}
        for letter, value in found_words:
            if letter in "GM":
                codes.append((letter, _tenths(file, number, text, letter, value)))
            elif letter == "O":
                if not PROGRAM_NUMBER.fullmatch(line):
                    raise wrong_line(file, number, text, NOT_RUN)
            elif letter != "N":
                if letter in values:
                    raise wrong_line(file, number, text, f"{letter} stands twice in one line; leave one")
                if len(value) > INPUT_LIMITS.number_characters:
                    why = f"{letter} has more than {INPUT_LIMITS.number_characters} digits"
                    raise wrong_line(file, number, text, why)
                values[letter] = float(value)
        if codes or values:
            yield Block(number, text, tuple(codes), values, skipped)


def _without_comments(file: FileName, number: int, text: str) -> str:
    line, semicolon, _ = text.partition(";") if "(" not in text.partition(";")[0] else (text, "", "")
    if not semicolon:
        line = COMMENT.sub(" ", text)
        line = line.partition(";")[0] if "(" not in line.partition(";")[0] else line
    if "(" in line or ")" in line:
        raise wrong_line(file, number, text, "a comment is not closed, or stands in another; close it by one ')'")
    return line


def _tenths(file: FileName, number: int, text: str, letter: str, value: str) -> int:
    exact = float(value) * 10 if len(value) < 9 else -1.0
    if exact < 0 or abs(exact - round(exact)) > 1e-6:
        raise wrong_line(file, number, text, f"{letter}{value} is no code; codes have one decimal at most")
    return round(exact)


def _refuse(file: FileName, number: int, text: str, line: str) -> None:
    if CONTROL.match(line):
        raise wrong_line(file, number, text, NOT_RUN)
    if any(sign in line for sign in "#[]=<>"):
        why = "parameters and expressions are not evaluated; post the program with plain numbers"
        raise wrong_line(file, number, text, why)
    rest = WORD.sub("", line)
    message = f"{rest[:20]!r} is no word of G-code, a letter and a number; correct it or make it a comment"
    raise wrong_line(file, number, text, message)
