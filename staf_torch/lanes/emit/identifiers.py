"""Names that a C header can give away: those that neither C nor C++ nor their libraries have taken."""

from __future__ import annotations

import re
import zlib
from collections.abc import Collection, Sequence

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
    """Return why a C header cannot use a name; None where it can, in C and in C++.

    Args:
        name: of a function or an argument.
        field: whether it is of a field of a structure, which may be called as functions are.
    """
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

    Args:
        call: whose ``argument`` they are, for the message.
        argument: likewise.
        names: that shall be free, and different from each other.
        beside: names that stand beside them already.
        field: as in `refused`.

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
    """Return the text of a header between guards that two headers of one name do not pass in silence.

    Args:
        name: of the function.
        body: the text without its comment at the head.
    """
    guard, number = f"{name.upper()}_H", f"0x{zlib.crc32(body.encode()):08x}"
    said = f'#error "another {name} is in this program already: export one of the two with another name"'
    lines = [f"#ifndef {guard}", f"#define {guard} {number}", "", body.strip("\n"), ""]
    return "\n".join([*lines, f"#elif {guard} != {number}", said, "#endif"]) + "\n"
