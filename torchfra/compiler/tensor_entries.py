"""How instructions read and write tensors."""

from __future__ import annotations

from torchfra.compiler.instructions import Code, Lanes, phi
from torchfra.compiler.plan import Access

PORT = "{ ptr, i64, i64, i64 }"
"""A tensor: where it is, and how far it is to the next track, the next step, the next entry."""
BLOCK = "{ i64, i64, i64, i64, i8 }"
"""A pack of tracks: the first, how many, the step, the one before, whether what is written is too much for caches."""
_BYTES = {"double": 8, "float": 4, "bool": 1}


class TensorEntries:
    """The entries of a tensor at a step, from the first track of a pack on."""

    def __init__(self, code: Code, access: Access) -> None:
        self._code = code
        self._scalar = code.lanes.scalar if access.type == "Scalar" else access.type
        self._bytes = _BYTES[self._scalar]

        def field(k: int) -> str:
            return code.load("i64" if k else "ptr", code.field(PORT, f"%{access.port}", k, access.number))

        def of_block(k: int) -> str:
            return code.load("i8" if k == 4 else "i64", code.field(BLOCK, "%at", k))

        data, self._track, time, entry = map(field, range(4))
        first, self._lanes, step = of_block(0), of_block(1), of_block(3 if access.before else 2)
        a, b = code.op("mul", first, self._track), code.op("mul", step, time)
        offset = code.op("mul", code.op("add", a, b), self._bytes)
        self._first = code.at(data, "i8", offset)
        self._step = code.op("mul", entry, self._bytes)
        if access.port == "out" and code.lanes.width > 1:
            self._some = code.new(f"icmp slt i64 {self._lanes}, {code.lanes.width}")
            bits = code.new(f"trunc i64 {self._lanes} to i32")
            power = code.new(f"shl i32 1, {bits}")
            ones = code.new(f"sub i32 {power}, 1")
            self._mask = code.new(f"trunc i32 {ones} to i{code.lanes.width}")
            address = code.new(f"ptrtoint ptr {self._first} to i64")
            odd = code.op("and", code.op("or", address, self._step), 63)
            is_even = code.new(f"icmp eq i64 {odd}, 0")
            even = code.new(f"zext i1 {is_even} to i8")
            self._past = code.new(f"and i8 {of_block(4)}, {even}")
        elif code.lanes.width > 1:
            self._full = code.new(f"icmp sge i64 {self._lanes}, {code.lanes.width}")

    def _at(self, entry: int) -> str:
        if entry == 0:
            return self._first
        offset = self._step if entry == 1 else self._code.op("mul", self._step, entry)
        return self._code.at(self._first, "i8", offset)

    def get(self, entry: int) -> str:
        """What lies anywhere: the last track stands for those beyond it."""
        code, where = self._code, self._at(entry)
        if code.lanes.width == 1:
            value = code.load(self._scalar, where, self._bytes)
        else:
            value = code.call(
                code.lanes.of(self._scalar),
                f"get_{self._scalar}",
                ("ptr", where),
                ("i64", self._track),
                ("i64", self._lanes),
            )
        return (
            value
            if self._scalar == code.lanes.scalar
            else code.new(f"fptrunc {code.lanes.of('double')} {value} to {code.numbers}")
        )

    def load(self, entry: int) -> str:
        """The same of tracks side by side."""
        code = self._code
        if code.lanes.width == 1:
            return self.get(entry)
        where = self._at(entry)
        few, many, behind = (code.named(word) for word in ("few", "many", "behind"))
        code.do(f"br i1 {self._full}, label %{many}, label %{few}, !prof !0")
        code.start(many)
        full = code.load(code.numbers, where, self._bytes)
        code.do(f"br label %{behind}")
        code.start(few)
        part = code.call(
            code.numbers, f"get_{self._scalar}", ("ptr", where), ("i64", self._track), ("i64", self._lanes)
        )
        code.do(f"br label %{behind}")
        code.start(behind)
        return phi(code, code.numbers, [(full, many), (part, few)])

    def write(self, entry: int, value: str) -> None:
        """Puts numbers there, past the caches if it is said so: such a store does not read the line first."""
        code, where = self._code, self._at(entry)
        if code.lanes.width == 1:
            code.store(code.numbers, value, where, self._bytes)
        elif code.lanes.registers == "avx512":  # no branch in sight, behind which fewer values would stay in registers
            plain = "vmovupd" if code.lanes.bits == 64 else "vmovups"
            text = (
                f"cmpb $$0, $2\\0A\\09je 1f\\0A\\09vmovntdq $1, $0\\0A\\09jmp 2f\\0A1:\\09{plain} $1, $0 {{$3}}\\0A2:"
            )
            wide = code.new(f"zext i{code.lanes.width} {self._mask} to i16") if code.lanes.width < 16 else self._mask
            args = f"ptr elementtype({code.numbers}) {where}, {code.numbers} {value}, i8 {self._past}, i16 {wide}"
            code.do(f'call void asm sideeffect "{text}", "=*m,v,q,^Yk,~{{flags}}"({args})')
        else:
            few, many, past, plain, behind = (code.named(w) for w in ("few", "many", "past", "plain", "behind"))
            code.do(f"br i1 {self._some}, label %{few}, label %{many}, !prof !1")
            code.start(few)
            code.call("void", "put", ("ptr", where), (code.numbers, value), ("i64", self._lanes))
            code.do(f"br label %{behind}")
            code.start(many)
            code.do(f"br i1 {code.new(f'icmp ne i8 {self._past}, 0')}, label %{past}, label %{plain}")
            code.start(past)
            code.do(f"store {code.numbers} {value}, ptr {where}, align {code.lanes.size}, !nontemporal !2")
            code.do(f"br label %{behind}")
            code.start(plain)
            code.store(code.numbers, value, where, self._bytes)
            code.do(f"br label %{behind}")
            code.start(behind)

    def mark(self, entry: int, value: str) -> None:
        """Puts truth values there."""
        code, where = self._code, self._at(entry)
        bytes_ = code.new(f"zext {code.truths} {value} to {code.lanes.of('i8')}")
        if code.lanes.width == 1:
            code.store("i8", bytes_, where, 1)
            return
        type = code.lanes.of("i8")
        mask = code.new(f"bitcast i{code.lanes.width} {self._mask} to {code.truths}")
        code.call(
            "void",
            f"llvm.masked.store.v{code.lanes.width}i8.p0",
            (type, bytes_),
            ("ptr", where),
            ("i32", "1"),
            (code.truths, mask),
        )


def functions(lanes: Lanes) -> tuple[list[str], set[str]]:
    """Functions that all kernels of such lanes call: their texts, and what they declare."""
    texts, declared = list[str](), set[str]()
    if lanes.width == 1:
        return texts, declared
    for scalar in dict.fromkeys((lanes.scalar, "double")):
        kind = lanes.of(scalar)
        code = Code(lanes, f"define internal {kind} @get_{scalar}(ptr %from, i64 %track, i64 %lanes)")
        same = code.new("icmp eq i64 %track, 0")
        with code.where(same):
            one = code.load(scalar, "%from", _BYTES[scalar])
            code.do(f"ret {kind} {code.spread(scalar, one)}")
            code.start(code.named("unreached"))
        last, value = code.op("sub", "%lanes", "1"), "poison"
        for k in range(lanes.width):
            number = code.call("i64", "llvm.smin.i64", ("i64", str(k)), ("i64", last))
            each = code.load(scalar, code.at("%from", scalar, code.op("mul", number, "%track")), _BYTES[scalar])
            value = code.new(f"insertelement {kind} {value}, {scalar} {each}, i64 {k}")
        code.do(f"ret {kind} {value}")
        texts.append(code.text())
        declared |= code.declared
    code = Code(lanes, f"define internal void @put(ptr %to, {code.numbers} %value, i64 %lanes)")
    memory = code.place(code.numbers)
    code.store(code.numbers, "%value", memory, lanes.size)
    with code.loop("%lanes") as number:
        one = code.load(lanes.scalar, code.at(memory, lanes.scalar, number), lanes.bits // 8)
        code.store(lanes.scalar, one, code.at("%to", lanes.scalar, number), lanes.bits // 8)
    code.do("ret void")
    texts.append(code.text())
    return texts, declared
