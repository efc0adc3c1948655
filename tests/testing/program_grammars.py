"""Grammars of the programs that pisigma writes for robot controllers.

They follow the languages' manuals, not the writers, and every line has to match.
"""

URSCRIPT = r"""
start: _remark* "def" NAME "(" ")" ":" _NL (_line)* "end" _NL
_line: _remark | assignment _NL | call _NL
_remark: REMARK _NL
assignment: NAME "=" _value
call: NAME "(" [_argument ("," _argument)*] ")"
_argument: _value | named
named: NAME "=" _value
_value: NUMBER | pose | list | call | NAME
pose: "p" list
list: "[" _value ("," _value)* "]"
REMARK: /#[ -~]*/
NAME: /[A-Za-z_][A-Za-z0-9_]*/
NUMBER: /-?[0-9]+(\.[0-9]+)?/
_NL: /\n/
%ignore / +/
"""

KRL = r"""
start: "&ACCESS RVP" _NL "&REL" INTEGER _NL "DEF" NAME "(" ")" _NL _declarations _instruction _line* "END" _NL
_declarations: (REMARK _NL | "DECL" ("INT" | "REAL") NAME _NL)*
_line: REMARK _NL | _instruction
_instruction: assignment _NL | "BAS" "(" "#INITMOV" "," INTEGER ")" _NL | loop | move _NL
loop: "FOR" NAME "=" INTEGER "TO" INTEGER _NL (assignment _NL)+ "ENDFOR" _NL
move: "PTP" aggregate
assignment: target "=" _value
target: (NAME | SYSTEM) ["[" NAME "]"]
_value: INTEGER | NAME | aggregate
aggregate: "{" TYPE ":" component ("," component)* "}"
component: LETTER REAL
TYPE: "AXIS" | "FRAME"
LETTER.2: /A[1-6](?= )|[XYZABC](?= )/
REMARK: /;[ -~]*/
SYSTEM: /\$[A-Z_]+/
NAME: /[A-Za-z][A-Za-z0-9_]{0,23}/
REAL: /-?[0-9]+\.[0-9]+/
INTEGER: /[0-9]+/
_NL: /\r\n/
%ignore / +/
"""

RAPID = r"""
start: "MODULE" NAME _NL (_remark | data)* procedure "ENDMODULE" _NL
_remark: REMARK _NL
data: ["LOCAL"] ("CONST" | "PERS") NAME NAME ":=" _value ";" _NL
procedure: "PROC" NAME "(" ")" _NL (_remark | _instruction _NL)* "ENDPROC" _NL
_instruction: configuration | axes | joint_move
configuration: "ConfJ" "\\" (ON | OFF) ";"
axes: "MoveAbsJ" array "," NAME "," NAME "," NAME ";"
joint_move: "MoveJ" array "," NAME "," NAME "," NAME "\\" "WObj" ":=" NAME ";"
_value: NUMBER | BOOLEAN | STRING | array
array: "[" _value ("," _value)* "]"
ON: "On"
OFF: "Off"
BOOLEAN.2: "TRUE" | "FALSE"
STRING: /"[^"]*"/
REMARK: /![ -~]*/
NAME: /[A-Za-z][A-Za-z0-9_]{0,31}/
NUMBER: /-?[0-9]+(\.[0-9]+)?(E[0-9]+)?/
_NL: /\r\n/
%ignore / +/
"""

FANUC = r"""
start: "/PROG" NAME _NL "/ATTR" _NL attribute+ "/MN" _NL line* "/POS" _NL position* "/END" _NL
attribute: KEY _EQ [VALUE] ";" _NL | "TCD:" KEY _EQ VALUE ("," _NL KEY _EQ VALUE)* ";" _NL
line: INTEGER ":" _instruction ";" _NL
_instruction: REMARK | setting | move
setting: (UFRAME | UTOOL) "=" INTEGER
move: "J" "P[" INTEGER "]" PERCENT "%" "FINE"
position: "P[" INTEGER "]" "{" _NL "GP1:" _NL "UF" ":" INTEGER "," "UT" ":" INTEGER "," (joints | pose) "}" ";" _NL
joints: _NL joint "," joint "," joint "," _NL joint "," joint "," joint _NL
joint: JOINT "=" REAL "deg"
pose: "CONFIG" ":" CONFIGURATION "," _NL length "," length "," length "," _NL angle "," angle "," angle _NL
length: LENGTH "=" REAL "mm"
angle: ANGLE "=" REAL "deg"
UFRAME: "UFRAME_NUM"
UTOOL: "UTOOL_NUM"
JOINT: /J[1-6]/
LENGTH: /[XYZ](?= )/
ANGLE: /[WPR](?= )/
CONFIGURATION: /'[NF] [UD] [TB], -?[0-9], -?[0-9], -?[0-9]'/
REMARK: /![ -:<-~]{0,32}?(?= ;)/
PERCENT: /[0-9]+(?=%)/
KEY: /[A-Z_]+(?= =)/
_EQ: /= ?/
VALUE: /"[ -!#-~]{0,16}"|[A-Z0-9_* ,]*[A-Z0-9_*](?=[;,]\r)/
NAME: /[A-Z][A-Z0-9_]{0,35}/
REAL: /-?[0-9]+\.[0-9]+/
INTEGER: /[0-9]+/
_NL: /\r\n/
%ignore /[ \t]+/
"""
