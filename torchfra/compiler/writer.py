"""C++ of a step: its pieces as functions, and what calls them."""

from __future__ import annotations

from torchfra.compiler.plan import Access, Plan
from torchfra.compiler.routines import texts
from torchfra.compiler.schedule import Piece
from torchfra.compiler.statements import as_number, as_truth, called, declared, function, indented, statement

_ALWAYS = "V* s, V* left, const Port* in, const Port* out, const Block& at"
"""What a function takes that is called at every step."""


class Writer:
    """Writes the functions of a step.

    Args:
        plan: how the step is computed.
        in_step: whether the threads of a GPU's block wait for each other at each step, so that they go through the same
            instructions at the same time: a long step does not fit into the cache of instructions.
    """

    def __init__(self, plan: Plan, in_step: bool = False) -> None:
        self.plan, self._step, self._book, self._in_step = plan, plan.step, plan.book, in_step
        self._before, self._steps, self._frame, self._behind = plan.before, plan.steps, plan.frame, plan.behind

    def texts(self) -> dict[str, str]:
        """What takes the place of each word of the template."""
        functions = {**texts(self._book, self._step.live), **self._begin()}
        before, calls = ["begin(s, left, in, at);"], ["__syncthreads();"] if self._in_step else []
        for k, piece in enumerate(self._before):
            functions[f"before{k}(V* s, const Port* in, const Block& at)"] = self._body(piece)
            before.append(f"before{k}(s, in, at);")
        stored = set[int]()
        for k, piece in enumerate(self._steps):
            if piece.guard is None:
                functions[f"piece{k}({_ALWAYS})"] = self._body(piece, stored)
                calls.append(f"piece{k}(s, left, in, out, at);")
            else:
                functions[f"piece{k}(V* s)"] = self._body(piece, stored)
                mask, value = piece.guard
                calls.append(
                    f"if (truth(s[{self._frame.places[mask]}]) == {'true' if value else 'false'}) piece{k}(s);"
                )
        functions |= self._turn(stored) | self._end()
        calls.append("turn(s, left, in, out, at);")
        return {
            "SIZE": str(self._frame.own),
            "UNREAD": str(self.plan.unread),
            "// PIECES\n": "".join(function(head, lines) for head, lines in functions.items()),
            "  // FIXED\n": indented(before, 2),
            "    // STEP\n": indented(calls, 4),
        }

    def _body(self, piece: Piece, stored: set[int] | None = None) -> list[str]:
        """The lines of a piece's function; ``stored``, if given, grows by what it writes."""
        body: list[str] = []
        late: list[str] = []
        opened: dict[str, str] = {}
        known = set(piece.numbers)
        named = ""
        for number in piece.numbers:
            access = self._step.loads.get(number)
            for arg in self._book.nodes[number][1]:
                if arg not in known and arg not in self._book.values:
                    body.append(self._taken(arg))
                    known.add(arg)
            if access is None:
                origin = self._book.origin[number]
                if origin not in ("", named):
                    body.append(f"// {origin}")
                    named = origin
                body += statement(self._book, number)
            else:
                opened[access.name] = access.opened
                body.append(declared(self._book, number, f"{access.how}({access.name}, {access.entry})"))
            if number in self._frame.places or number in self._frame.left:
                (late if number in self._frame.late else body).append(self._put_aside(number))
            for other, access in self._behind[number] if stored is not None else ():
                opened[access.name] = access.opened
                if other not in known and other not in self._book.values:
                    body.append(self._taken(other))
                    known.add(other)
                body.append(self._written(other, access))
        if stored is not None:
            stored.update(other for number in piece.numbers for other, _ in self._behind[number])
        return [*opened.values(), *body, *late]

    def _taken(self, number: int) -> str:
        """The line that takes a value from its place."""
        place = self._place(number)
        return declared(self._book, number, f"truth({place})" if self._book.is_bool(number) else place)

    def _put_aside(self, number: int) -> str:
        name = called(self._book, number)
        return f"{self._place(number)} = {f'kept({name})' if self._book.is_bool(number) else name};"

    def _place(self, number: int) -> str:
        """The place of a value."""
        place = self._frame.places.get(number)
        return f"left[{self._frame.left[number]}]" if place is None else f"s[{place}]"

    def _written(self, number: int, access: Access) -> str:
        value = (as_truth if access.how == "mark" else as_number)(self._book, number)
        return f"{access.how}({access.name}, {access.entry}, {value});"

    def _begin(self) -> dict[str, list[str]]:
        """The function that reads what is carried."""
        opened = dict.fromkeys(access.opened for access in self._step.first.values())
        reads = [f"{self._place(i)} = get({access.name}, {access.entry});" for i, access in self._step.first.items()]
        return {"begin(V* s, V* left, const Port* in, const Block& at)": [*opened, *reads]}

    def _turn(self, stored: set[int]) -> dict[str, list[str]]:
        """The function that ends a step: it writes what no piece has computed, and moves what is carried on."""
        stores = [(i, access) for i, access in self._step.stores if i not in stored]
        opened = dict.fromkeys(access.opened for _, access in stores)
        numbers = dict.fromkeys([*(i for i, _ in stores), *(i for i, _ in self._frame.moves)])
        taken = [self._taken(i) for i in numbers if i not in self._book.values]
        writes = [self._written(i, access) for i, access in stores]
        moves = [f"s[{place}] = {as_number(self._book, i)};" for i, place in self._frame.moves]
        return {f"turn({_ALWAYS})": [*opened, *taken, *writes, *moves]}

    def _end(self) -> dict[str, list[str]]:
        """The function that writes what the last step has carried."""
        opened = dict.fromkeys(access.opened for _, access in self._step.end)
        writes = [
            f"put({access.name}, {access.entry}, {self._place(i) if i in self._step.carried else 'all(0)'});"
            for i, access in self._step.end
        ]
        return {"end(V* s, V* left, const Port* out, const Block& at)": [*opened, *writes]}
