"""A scalar program for single rows: plain C with the carry in a struct, or CUDA C with a thread a row."""

from __future__ import annotations

import bisect
import math
import re
import zlib
from collections.abc import Collection, Sequence
from typing import ClassVar, NamedTuple

from ..trace.graph import FLAG, NARROW, REAL, ROW, STEP, WHOLE, WIDE, Graph, Sizes
from .matrices import MatrixWriter
from .schedule import Schedule, constants

_NAMES = {"abs": "fabs", "round": "rint"}


class Names(NamedTuple):
    """Names of the arguments of a function."""

    rows: Sequence[str]
    nows: Sequence[str]
    carries: Sequence[str]
    outputs: Sequence[str]


class CTable(NamedTuple):
    """Numbers that stand in the table of a C text: the parameters of a graph, and what each is called."""

    values: Sequence[float] = ()
    said: Sequence[str] = ()


NO_NUMBERS = CTable()


def random_numbers(lines: Sequence[str], real: str, qualifiers: str) -> list[str]:
    """Return the functions of random numbers that statements call: `trace.philox` in words of 32 bits."""
    suffix = "f" if real == "float" else ""
    if not any("philox_" in line for line in lines):
        return []
    given = ", ".join(f"{real} {name}" for name in "abcdefg")
    names = f"philox_first{suffix}", f"philox_second{suffix}"
    ends = ("x << 21 | y >> 11", "z << 21 | w >> 11")
    return [
        line
        for name, end in zip(names, ends, strict=True)
        for line in (
            _PHILOX % {"how": qualifiers, "real": real, "name": name, "given": given, "end": end}
        ).splitlines()
    ]


_PHILOX = """%(how)s %(real)s %(name)s(%(given)s)
{
    unsigned long long one = (unsigned long long)a + ((unsigned long long)b << 16), p, q, whole;
    unsigned long long other = (unsigned long long)c + ((unsigned long long)d << 16);
    unsigned long long x = (unsigned long long)e + ((unsigned long long)f << 16), y = (unsigned long long)g;
    unsigned long long z = 0, w = 0;
    int k;
    for (k = 0; k < 10; ++k) {
        p = x * 0xD2511F53u, q = z * 0xCD9E8D57u;
        x = (q >> 32) ^ y ^ one, y = q & 0xFFFFFFFFu, z = (p >> 32) ^ w ^ other, w = p & 0xFFFFFFFFu;
        one = (one + 0x9E3779B9u) & 0xFFFFFFFFu, other = (other + 0xBB67AE85u) & 0xFFFFFFFFu;
    }
    whole = %(end)s;
    return (%(real)s)((long long)whole - (1ll << 52)) * (%(real)s)2.220446049250313e-16;
}
"""


class ScalarWriter(MatrixWriter):
    """Writer of scalar code, common to C and CUDA C: every number is a variable of its own."""

    _infix: ClassVar[dict[str, str]] = MatrixWriter._infix | {"and": "&&", "or": "||", "xor": "!="}
    _prefix: ClassVar[dict[str, str]] = MatrixWriter._prefix | {"not": "!"}

    def __init__(self, graph: Graph, schedule: Schedule, layout: Sizes, names: Names) -> None:
        self.real, self._suffix = ("float", "f") if graph.single else ("double", "")
        types = {REAL: self.real, WHOLE: self.real, WIDE: "double", NARROW: "double", FLAG: "int"}
        super().__init__(graph, schedule, layout, types)
        self._names = {"row": names.rows, "now": names.nows, "state": names.carries}

    def _call(self, op: str, values: Sequence[str], type: str) -> str:
        if op == "cast":
            return f"({self.types[type]}){values[0]}"
        if op == "where":
            return f"{values[0]} ? {values[1]} : {values[2]}"
        if op in ("min", "max"):
            a, b = values  # NaN wins
            return f"{a} {'<' if op == 'min' else '>'} {b} || {a} != {a} ? {a} : {b}"
        return f"{_NAMES.get(op, op)}{'' if type == WIDE else self._suffix}({', '.join(values)})"

    def _nobody(self, mask: int) -> str:
        return f"!({self._ref(mask, 0)})"

    def _narrowed(self, text: str) -> str:
        return f"(double)(float)({text})"

    def _fma(self, a: str, b: str, c: str) -> str:
        return f"{a} * {b} - {c[1:]}" if c.startswith("-") else f"{a} * {b} + {c}"

    def _stated(self, value: float, type: str) -> str:
        return self._number(value, type)

    def _literal(self, node: int) -> str:
        value = self.graph.value(node)
        assert value is not None
        return self._number(value, self.graph.type[node])

    def _number(self, value: float | bool, type: str) -> str:
        if isinstance(value, bool):
            return str(int(value))
        narrow = self.graph.single and type != WIDE
        if not math.isfinite(value):  # the macros are float, whatever stands beside them
            text = ("" if narrow else "(double)") + ("NAN" if math.isnan(value) else "INFINITY")
            return f"(-{text})" if value < 0 else text
        text = f"{value:.9g}" if narrow else repr(value)
        text += ("" if any(c in text for c in ".e") else ".0") + ("f" if narrow else "")
        return f"({text})" if math.copysign(1.0, value) < 0 else text

    def _table(self, pack: int, at: str) -> str:
        graph, kind = self.graph, self.graph.type[pack]
        values = (self._number(graph.value(a) or 0.0, kind) for a in graph.args[pack])
        self._constant_array(f"c{pack}", self.types[kind], values)
        return f"c{pack}[{at}]"

    def _typed(self, node: int, text: str) -> str:
        return f"({text} != 0)" if self.graph.type[node] == FLAG else text

    def _slot(self, op: str, place: int) -> tuple[int, int]:
        """The input that a place belongs to, and the entry in it."""
        starts = self._starts[op]
        slot = bisect.bisect_right(starts, place) - 1
        while starts[slot + 1] == starts[slot]:
            slot += 1
        return slot, place - starts[slot]

    def _in_place(self, pack: int) -> tuple[str, int] | None:
        found = super()._in_place(pack)
        if found is None or found[0] == "table":
            return found
        op, first = found
        last = first + len(self.graph.args[pack]) - 1
        return found if self._slot(op, first)[0] == self._slot(op, last)[0] else None

    def _carries(self) -> list[tuple[int, int]]:
        """Every node of the carry that is read, and its place."""
        graph = self.graph
        read = (n for n in sorted(self.schedule.live) if graph.op[n] == "state")
        return [(n, self._starts["state"][graph.aux[n][0]] + graph.aux[n][1]) for n in read]


class _CWriter(ScalarWriter):
    def __init__(
        self, graph: Graph, schedule: Schedule, layout: Sizes, names: Names, table: str, numbers: CTable
    ) -> None:
        super().__init__(graph, schedule, layout, names)
        self._table_name, self._numbers = table, numbers
        self._places: dict[int, int] = {}  # in the table, of parameters of the graph
        self._packs: dict[int, int] = {}  # of arrays, where they begin
        self._numbered: list[int] = []  # the node of every place
        self._lay_out()

    def _lay_out(self) -> None:
        """Find a place for every parameter: those of an array side by side, as far as they can be."""
        graph, live = self.graph, sorted(self.schedule.live)
        fixed = [node for node in live if constants(graph, node)]
        for pack in fixed:
            numbers = [graph.aux[node] for node in graph.args[pack] if graph.op[node] == "param"]
            free = len({*numbers}) == len(numbers) and self._places.keys().isdisjoint(numbers)
            if numbers and free and not self._wide(pack):
                self._packs[pack] = len(self._numbered)
                self._enter(graph.args[pack])
        held = [node for pack in fixed for node in graph.args[pack]]
        params = {node for node in (*live, *held) if graph.op[node] == "param" and not self._wide(node)}
        numbered = sorted(params, key=lambda node: int(graph.aux[node]))
        self._enter([node for node in numbered if graph.aux[node] not in self._places])

    def _enter(self, nodes: Sequence[int]) -> None:
        for place, node in enumerate(nodes, len(self._numbered)):
            if self.graph.op[node] == "param":
                self._places[self.graph.aux[node]] = place
        self._numbered += nodes

    def _wide(self, node: int) -> bool:
        """Return whether the table, of floats, has not the digits of a number."""
        return self.graph.single and self.graph.type[node] == WIDE

    def _literal(self, node: int) -> str:
        if self.graph.op[node] != "param":
            return super()._literal(node)
        number = self.graph.aux[node]
        if self._wide(node):
            return self._number(self._numbers.values[number], WIDE)
        return f"{self._table_name}[{self._places[number]}]"

    def _table(self, pack: int, at: str) -> str:
        nodes = self.graph.args[pack]
        if all(self.graph.op[node] == "const" for node in nodes):
            return super()._table(pack, at)
        if (first := self._packs.get(pack)) is not None:
            return f"{self._table_name}[{f'{first} + {at}' if first else at}]"
        if (name := f"c{pack}") not in self._arrays:  # its numbers lie elsewhere, in another order
            self._arrays.add(name)
            entries = ", ".join(map(self._literal, nodes))
            self._lines.insert(1, f"    const {self._type(pack)} {name}[] = {{{entries}}};")
        return f"{name}[{at}]"

    @property
    def entries(self) -> int:
        """How many numbers of the program are in the table."""
        return len(self._numbered)

    def table(self, name: str, more: CTable) -> list[str]:
        """Return the table and what may be defined for it; ``more`` are numbers behind the parameters."""
        known, graph = self._numbers, self.graph
        values, said = [], []
        for node in self._numbered:
            stated = graph.value(node)
            values.append(known.values[graph.aux[node]] if stated is None else float(stated))
            said.append(known.said[graph.aux[node]] if stated is None else "of the code")
        values, said = [*values, *more.values], [*said, *more.said]
        if not values:
            return []
        macro = f"{name.upper()}_NUMBERS"
        texts = [self._number(value, REAL) for value in values]
        texts = [text[1:-1] if text.startswith("(-") else text for text in texts]
        return [
            *(_ABOUT % {"name": name, "macro": macro}).splitlines(),
            f"{macro} {self.real} {self._table_name}[{len(texts)}] = {{",
            *_commented_rows(texts, said),
            "};",
            "",
        ]

    def _buffer(self, op: str, place: int, j: int, at: str = "0") -> str:
        slot, entry = self._slot(op, place)
        return f"{self._names[op][slot]}[{entry if at == '0' else f'{entry} + {at}' if entry else at}]"

    def body(self, names: Names, following: Sequence[int], outputs: Sequence[int]) -> None:
        self._lines.append("{")
        for name in (*names.rows, *names.nows):
            self._line(f"(void){name};")
        if names.carries:
            self._line("(void)state;")
        for node, place in self._carries():
            slot, entry = self._slot("state", place)
            value = self._typed(node, f"state->{names.carries[slot]}[{entry}]")
            self._line(f"const {self._type(node)} s{place} = {value};")
        self._block(self.schedule.block(ROW))
        self._block(self.schedule.block(STEP))
        done = 0
        for name, size in zip(names.outputs, self.layout.outputs, strict=True):
            for e in range(size):
                self._line(f"{name}[{e}] = {self._cast(outputs[done + e])};")
            done += size
        for place, node in enumerate(following):
            slot, entry = self._slot("state", place)
            if self._ref(node, 0) != f"s{place}":
                self._line(f"state->{names.carries[slot]}[{entry}] = {self._cast(node)};")
        self._lines.append("}")

    def _cast(self, node: int) -> str:
        return f"({self.real}){self._ref(node, 0)}" if self.graph.type[node] == FLAG else self._ref(node, 0)


def _commented_rows(texts: Sequence[str], said: Sequence[str]) -> list[str]:
    """Return the entries of a table, one a line; several where one comment is that of all."""
    lines, first = list[str](), 0
    while first < len(texts):
        last = first + 1
        while last < min(first + _A_LINE, len(texts)) and said[last] == said[first]:
            last += 1
        what = f": {said[first]}" if not first or said[first] != said[first - 1] else ""
        lines.append(f"    {', '.join(texts[first:last])}, /* {first}{what} */")
        first = last
    return lines


_A_LINE = 8
_ABOUT = """/*
 * The numbers of %(name)s. They are constants of which a compiler computes what follows, as long as nothing
 * else is defined before this file is included: `#define %(macro)s static` lets a program write to the
 * table while it runs, `static const volatile __attribute__((section(".calibration")))` a tool to flash.
 */
#ifndef %(macro)s
#define %(macro)s static const
#endif"""


def c_text(
    graph: Graph,
    layout: Sizes,
    following: Sequence[int],
    outputs: Sequence[int],
    *,
    name: str,
    names: Names,
    start: Sequence[float],
    note: str = "",
    numbers: CTable = NO_NUMBERS,
) -> str:
    """Return a C99 header with one step of a program: it needs math.h, and no memory but the stack.

    The carry is ``struct NAME_state``, which ``NAME_start`` sets to its first numbers and ``NAME`` advances.
    What the program captured, and those first numbers, are the table ``NAME_numbers``.
    All numbers, flags and integers too, are double (float for a program of float32).

    Raises:
        ValueError: if a name is not one of C, or is there twice.
    """
    table = f"{name}_numbers"
    inputs, stays = [*names.rows, *names.nows], [*(["state"] if names.carries else []), table]
    checked_names("c_source", "name", [name], [*inputs, *stays[:-1], *names.outputs])
    checked_names("c_source", "row", inputs, [*stays, "p", "q"])  # indices of loops
    checked_names("c_source", "carry", list(names.carries), field=True)
    if len(names.outputs) != len(layout.outputs):
        rule = f"must be {len(layout.outputs)} names, one an output"
        raise ValueError(f"`c_source(outputs=...)` {rule}; got {list(names.outputs)}.")
    checked_names("c_source", "outputs", list(names.outputs), [*inputs, *stays])
    writer = _CWriter(graph, Schedule(graph, following, outputs), layout, names, table, numbers)
    places = [(n, e) for n, size in zip(names.carries, layout.carries, strict=True) for e in range(size)]
    real, lines = writer.real, ["#include <math.h>", ""]
    lines += writer.table(name, CTable(start, [f"{n}[{e}] at the start" for n, e in places]))
    arguments = [f"{name}_state *state"] if names.carries else []
    if names.carries:
        fields = zip(names.carries, layout.carries, strict=True)
        lines += [
            "typedef struct {",
            *(f"    {real} {n}[{size}];" for n, size in fields),
            f"}} {name}_state;",
        ]
        lines += ["", f"static inline void {name}_start({name}_state *state)", "{"]
        first = writer.entries
        lines += [f"    state->{n}[{e}] = {table}[{k}];" for k, (n, e) in enumerate(places, first)]
        lines += ["}", ""]
    for given, sizes in ((names.nows, layout.nows), (names.rows, layout.rows)):
        arguments += [f"const {real} {n}[{size}]" for n, size in zip(given, sizes, strict=True)]
    arguments += [f"{real} {n}[{size}]" for n, size in zip(names.outputs, layout.outputs, strict=True)]
    body = writer._function(lambda: writer.body(names, following, outputs))
    lines += random_numbers(body, real, "static inline")
    lines += [f"static inline void {name}({', '.join(arguments)})", *body]
    return commented(note) + guarded(name, "\n".join(lines))


def commented(note: str) -> str:
    """Return lines as the comment at the head of a header; nothing of no lines."""
    inside = note.replace("*/", "* /").replace("/*", "/ *")
    lines = (f" * {line}".rstrip() for line in inside.splitlines())
    return "\n".join(["/*", *lines, " */", ""]) if note else ""


_FORM = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_LOCAL = re.compile(r"[acilmprstyS]\d+(_\d+)*|(old|own)_.*")  # of the statements that are written
_C = """alignas alignof asm auto bool break case char const constexpr continue default do double else
    enum extern false float for goto if inline int long nullptr register restrict return short signed
    sizeof static static_assert struct switch thread_local true typedef typeof typeof_unqual union
    unsigned void volatile while fortran"""
_CPP = """and and_eq atomic_cancel atomic_commit atomic_noexcept bitand bitor catch char8_t char16_t
    char32_t class co_await co_return co_yield compl concept consteval constinit const_cast decltype
    delete dynamic_cast explicit export friend mutable namespace new noexcept not not_eq operator or
    or_eq private protected public reflexpr reinterpret_cast requires static_cast synchronized template
    this throw try typeid typename using virtual wchar_t xor xor_eq std linux unix"""
_MATH = """acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc exp exp2 expm1
    fabs fdim floor fma fmax fmin fmod frexp hypot ilogb ldexp lgamma llrint llround log log10 log1p log2
    logb lrint lround modf nan nearbyint nextafter nexttoward pow remainder remquo rint round scalbln
    scalbn sin sinh sqrt tan tanh tgamma trunc j0 j1 jn y0 y1 yn gamma drem finite significand exp10
    pow10 sincos scalb"""
_MACROS = """signbit isfinite isinf isnan isnormal fpclassify isgreater isgreaterequal isless islessequal
    islessgreater isunordered signgam NAN INFINITY HUGE_VAL HUGE_VALF HUGE_VALL MATH_ERRNO MATH_ERREXCEPT
    math_errhandling FP_NAN FP_INFINITE FP_ZERO FP_SUBNORMAL FP_NORMAL FP_FAST_FMA FP_ILOGB0 FP_ILOGBNAN
    M_E M_LOG2E M_LOG10E M_LN2 M_LN10 M_PI M_PI_2 M_PI_4 M_1_PI M_2_PI M_2_SQRTPI M_SQRT2 M_SQRT1_2 NULL
    EOF BUFSIZ RAND_MAX EXIT_SUCCESS EXIT_FAILURE CHAR_BIT INT_MAX INT_MIN DBL_MAX DBL_MIN DBL_EPSILON
    FLT_MAX FLT_MIN FLT_EPSILON assert errno offsetof complex imaginary I stdin stdout stderr noreturn
    setjmp va_list va_start va_arg va_end va_copy"""
_LIBRARY = """main abort abs aligned_alloc asctime atexit atof atoi atol atoll bsearch calloc clearerr
    clock ctime difftime div exit fclose feof ferror fflush fgetc fgetpos fgets fopen fprintf fputc fputs
    fread free freopen fscanf fseek fsetpos ftell fwrite getc getchar getenv gets gmtime isalnum isalpha
    isblank iscntrl isdigit isgraph islower isprint ispunct isspace isupper isxdigit labs ldiv llabs
    lldiv localeconv localtime longjmp malloc mblen mbtowc memchr memcmp memcpy memmove memset mktime
    perror printf putc putchar puts qsort quick_exit raise rand realloc remove rename rewind scanf setbuf
    setlocale setvbuf signal snprintf sprintf srand sscanf strcat strchr strcmp strcoll strcpy strcspn
    strerror strftime strlen strncat strncmp strncpy strpbrk strrchr strspn strstr strtod strtof strtok
    strtol strtoul strxfrm system time time_t clock_t size_t ptrdiff_t tmpfile tmpnam tolower toupper
    ungetc vfprintf vprintf vsprintf wcstombs wctomb int8_t int16_t int32_t int64_t uint8_t uint16_t
    uint32_t uint64_t intptr_t uintptr_t float_t double_t"""
_WORDS = {**dict.fromkeys(_CPP.split(), "a word of C++"), **dict.fromkeys(_C.split(), "a word of C")}
_WORDS |= dict.fromkeys(_MACROS.split(), "a name of the C library")
_FUNCTIONS = {name + end: "a function of math.h" for name in _MATH.split() for end in ("", "f", "l")}
_FUNCTIONS |= dict.fromkeys(_LIBRARY.split(), "a name of the C library")


def refused(name: object, *, field: bool = False) -> str | None:
    """Return why a C header cannot use a name; None where it can, in C and in C++."""
    if not isinstance(name, str) or not _FORM.fullmatch(name):
        return "not a letter that letters, digits and _ follow"
    if "__" in name:
        return "reserved in C++, as every name with two _ in a row"
    if name in _WORDS or field:
        return _WORDS.get(name)
    if _LOCAL.fullmatch(name):
        return "like the names that the header's own statements have (a letter and digits, old_, own_)"
    return _FUNCTIONS.get(name)


def checked_names(
    call: str,
    argument: str,
    names: Sequence[object],
    beside: Collection[object] = (),
    *,
    field: bool = False,
) -> None:
    """Refuse names that cannot stand beside each other in a C header.

    Raises:
        ValueError: that names the argument, the rule and the value.
    """
    where = f"`{call}({argument}=...)`"
    for name in names:
        why = refused(name, field=field)
        if why is not None:
            raise ValueError(f"{where} must be free names of C and C++; got {name!r}, which is {why}.")
        if name in beside:
            taken = ", ".join(map(str, beside))
            raise ValueError(f"{where} must differ from what is there already, {taken}; got {name!r}.")
    twice = [str(name) for name in names if names.count(name) > 1]
    if twice:
        raise ValueError(f"{where} must have every name once; got {twice[0]!r} twice.")


def guarded(name: str, body: str) -> str:
    """Return the text of a header between guards that two headers of one name do not pass in silence."""
    guard, number = f"{name.upper()}_H", f"0x{zlib.crc32(body.encode()):08x}"
    said = f'#error "another {name} is in this program already: export one of the two with another name"'
    lines = [f"#ifndef {guard}", f"#define {guard} {number}", "", body.strip("\n"), ""]
    return "\n".join([*lines, f"#elif {guard} != {number}", said, "#endif"]) + "\n"
