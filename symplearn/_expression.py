"""Text of a simulation file -> SymPy tree, without ever executing text.

A tokenizer and a recursive-descent parser of our own. SymPy is handed finished nodes; no text
reaches `sympify`, `parse_expr`, `eval` or `lambdify`.
"""

import math
import re
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Never

import sympy

from . import _tree
from ._errors import InputError, nearest, shown

LONGEST = 10_000
DEEPEST = 100
RESERVED = frozenset(_tree.FUNCTIONS) | {"t", "pi"}
NAME = re.compile(r"[A-Za-z_][A-Za-z_0-9]*")

_TOKEN = re.compile(
    r"(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z_0-9]*)"
    r"|(?P<operator>\*\*|[-+*/(),])"
    r"|(?P<space>[ \t\r\n]+)"
)
_ADVICE = {
    "^": "a power is written **",
    ".": "attributes are not part of an expression",
    "[": "indexing is not part of an expression",
    "{": "use round brackets",
    "'": "text in quotes is not part of an expression",
    '"': "text in quotes is not part of an expression",
    ";": "an expression is a single formula",
    **dict.fromkeys("<>=!", "comparisons and assignments are not part of an expression; use min, max, abs or sign"),
}


@dataclass(frozen=True)
class Expression:
    """An expression of a simulation file: the user's own words and the tree they stand for."""

    text: str
    tree: sympy.Expr


def symbol(name: str) -> sympy.Symbol:
    """The SymPy symbol that stands for a declared name, or for `t`."""
    return sympy.Symbol(name, real=True)


def parse_expression(text: str, names: Collection[str], *, where: str) -> sympy.Expr:
    """The SymPy tree of an expression; symbols are real.

    Numbers are small exact fractions or doubles, parts without a symbol are computed, and no exact number can
    grow, so SymPy's work on the result is bounded by the length of the text.

    **Arguments:**

    - `text`: at most 10,000 characters, nested at most 100 deep. Precedence is Python's: `-x**2` is
        `-(x**2)` and `a**b**c` is `a**(b**c)`.
    - `names`: the declared names; `t`, `pi` and the functions of the contract are known besides.
    - `where`: file and place, the beginning of the sentence if something is wrong.

    **Raises** `InputError` for anything else, naming the character (counted from 1) where it stands.
    """
    if len(text) > LONGEST:
        raise InputError(f"{where}: the expression has {len(text):,} characters; at most {LONGEST:,} are read")
    _check_depth(text, where)
    try:
        with _deep_recursion():
            return _Parser(text, names, where).whole()
    except RecursionError:
        raise InputError(f"{where}: the expression is nested too deeply to work with; nest less deeply") from None


@contextmanager
def _deep_recursion() -> Iterator[None]:
    """Room for SymPy, which spends about ten frames on each level of an expression."""
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(max(before, 5_000))
    try:
        yield
    finally:
        sys.setrecursionlimit(before)


def _check_depth(text: str, where: str) -> None:
    depth = 0
    for position, character in enumerate(text, start=1):
        depth += (character == "(") - (character == ")")
        if depth > DEEPEST:
            raise InputError(
                f"{where}: more than {DEEPEST} brackets are open at character {position}; nest less deeply"
            )


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str
    position: int  # counted from 1


def _tokens(text: str, where: str) -> Iterator[_Token]:
    index = 0
    while index < len(text):
        match = _TOKEN.match(text, index)
        if match is None:
            character = text[index]
            advice = _ADVICE.get(character, "an expression holds names, numbers, + - * / **, brackets and commas")
            raise InputError(f"{where}: unexpected {shown(character)} at character {index + 1}; {advice}")
        kind = match.lastgroup or ""
        if kind != "space":
            yield _Token(kind, match.group(), index + 1)
        index = match.end()
    yield _Token("end", "", len(text) + 1)


class _Parser:
    """Recursive descent: a sum of products of signed powers of atoms."""

    def __init__(self, text: str, names: Collection[str], where: str):
        self.names, self.where = names, where
        self.tokens = list(_tokens(text, where))
        self.index = self.depth = 0

    @property
    def token(self) -> _Token:
        return self.tokens[self.index]

    def take(self, *operators: str) -> _Token | None:
        """The next token where it is one of `operators`; it is then used up."""
        token = self.token
        if token.kind != "operator" or token.text not in operators:
            return None
        self.index += 1
        return token

    def refuse(self, token: _Token, what: str, advice: str = "") -> Never:
        raise InputError(f"{self.where}: {what} at character {token.position}" + (f"; {advice}" if advice else ""))

    def whole(self) -> sympy.Expr:
        if self.token.kind == "end":
            raise InputError(f"{self.where}: the expression is empty; write a formula such as `p**2/2`")
        result = self.sum()
        token = self.token
        if token.kind in ("name", "number") or token.text == "(":
            self.refuse(token, f"an operator is missing before {shown(token.text)}", "a product is written with *")
        if token.kind != "end":
            self.refuse(token, f"unexpected {shown(token.text)}")
        return result

    def deeper(self, token: _Token) -> None:
        self.depth += 1
        if self.depth > DEEPEST:
            self.refuse(token, f"the expression is nested more than {DEEPEST} deep")

    def built(self, token: _Token, build, *arguments) -> sympy.Expr:
        """A new node of the tree, or the sentence why it has no value."""
        try:
            return build(*arguments)
        except _tree.NotANumber as reason:
            self.refuse(token, f"the part with {shown(token.text)} {reason},")

    def sum(self) -> sympy.Expr:
        first = self.token
        terms = [self.product()]
        while operator := self.take("+", "-"):
            term = self.product()
            terms.append(
                self.built(operator, _tree.product, (sympy.S.NegativeOne, term)) if operator.text == "-" else term
            )
        return self.built(first, _tree.total, terms)

    def product(self) -> sympy.Expr:
        first = self.token
        factors = [self.signed()]
        while operator := self.take("*", "/"):
            factor = self.signed()
            factors.append(self.built(operator, _tree.reciprocal, factor) if operator.text == "/" else factor)
        return self.built(first, _tree.product, factors)

    def signed(self) -> sympy.Expr:
        first, negative = self.token, False
        while operator := self.take("+", "-"):
            negative ^= operator.text == "-"
        value = self.power()
        return self.built(first, _tree.product, (sympy.S.NegativeOne, value)) if negative else value

    def power(self) -> sympy.Expr:
        base = self.atom()
        operator = self.take("**")
        if operator is None:
            return base
        self.deeper(operator)
        exponent = self.signed()
        self.depth -= 1
        return self.built(operator, _tree.power, base, exponent)

    def atom(self) -> sympy.Expr:
        token = self.token
        self.index += token.kind != "end"
        if token.kind == "number":
            return self.built(token, _tree.number, float(token.text))
        if token.kind == "name":
            return self.named(token)
        if token.text == "(":
            self.deeper(token)
            value = self.sum()
            self.close(token)
            return value
        what = "the expression ends too early" if token.kind == "end" else f"unexpected {shown(token.text)}"
        self.refuse(token, what, "a number, a name or a bracket is needed")

    def close(self, opening: _Token) -> None:
        token = self.token
        if self.take(")"):
            self.depth -= 1
        elif token.kind in ("name", "number") or token.text == "(":
            self.refuse(token, f"an operator is missing before {shown(token.text)}", "a product is written with *")
        elif token.kind == "end":
            self.refuse(opening, "a bracket is never closed, the one opened")
        else:
            self.refuse(token, f"unexpected {shown(token.text)}", "a closing bracket is needed")

    def named(self, token: _Token) -> sympy.Expr:
        name = token.text
        bracket = self.token if self.token.text == "(" else None
        if name in _tree.FUNCTIONS:
            if bracket is None:
                self.refuse(token, f"function without brackets {shown(name)}", f"write {name}(...)")
            return self.called(token)
        if bracket is not None and name not in self.names and name not in RESERVED:
            self.refuse(token, f"unknown function {shown(name)}", nearest(name, _tree.FUNCTIONS))
        if bracket is not None:
            self.refuse(bracket, f"an operator is missing after {shown(name)}", "a product is written with *")
        if name == "pi":
            return sympy.Float(math.pi)
        if name != "t" and name not in self.names:
            self.refuse(token, f"undeclared name {shown(name)}", nearest(name, [*self.names, "t"]))
        return symbol(name)

    def called(self, token: _Token) -> sympy.Expr:
        opening = self.token
        self.index += 1
        self.deeper(opening)
        arguments = [] if self.token.text == ")" else [self.sum()]
        while self.take(","):
            arguments.append(self.sum())
        self.close(opening)
        count = _tree.FUNCTIONS[token.text][2]
        if len(arguments) != count if count else len(arguments) < 2:
            needed = f"{count} argument{'s' if count != 1 else ''}" if count else "two or more arguments"
            self.refuse(token, f"{len(arguments)} given to {shown(token.text)}", f"it takes {needed}")
        return self.built(token, _tree.call, token.text, arguments)
