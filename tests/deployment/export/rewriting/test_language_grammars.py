"""URScript, KRL and FANUC programs comply with grammars of the languages, which are in `grammars`."""

import re
from pathlib import Path

import pytest
import torch
from lark.exceptions import LarkError
from testing.arc_programs import ARC_PROGRAMS, arc_poses, arc_request
from testing.language_grammars import check_program
from testing.rewritten_programs import LANGUAGES, inline_points, program

from pisigma.deployment.export.programs.languages import program_text
from pisigma.deployment.export.programs.planned import planned_program
from pisigma.deployment.export.programs.targets import Targets
from pisigma.deployment.export.registry import export_model
from pisigma.planning.plan_file import StoredPlan
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status

SUFFIXES = (".script", ".src", ".ls")
HOSTILE = 'a";\nEND\r\n;}]) "\'` Zelle-ü \x00\t %s {0} ' + "x" * 300


def written(suffix: str) -> list[str]:
    """Programs of a plan with waypoints, of joint targets, and of poses with a hostile name of the model."""
    file, q = Path(f"cell{suffix}"), torch.linspace(-3, 3, 24, dtype=torch.float64).reshape(4, 6)
    arm, settings = ArmInSurroundings.from_robot(Robot.load("fanuc_r2000")), PlanSettings(settling_s=2.5)
    turned, order = torch.tensor([False, True]), torch.tensor([4, 7])
    plan = StoredPlan(arm, settings, None, q[[0, 3]], turned, order, (q[:0], q[1:3]))
    texts = [planned_program(plan, file)]
    for name, model, cartesian in (("rb5", "cell_3", False), ("ur10", HOSTILE, True)):
        robot, reached = Robot.load(name), (Status.REACHED,) * 4
        T, none = forward_kinematics(robot, q), torch.full((4,), torch.nan, dtype=torch.float64)
        targets = Targets(model, robot, "poses.csv", (2, 3, 4, 5), reached, ("only",) * 4, q, T, none)
        config = "N U T, 0, 0, 0" if cartesian and suffix == ".ls" else None
        texts.append(program_text(targets, file, cartesian, config))
    return texts


@pytest.fixture(scope="module")
def programs(arm, tmp_path_factory) -> dict[str, list[str]]:
    """Every kind of program that is exported, by the suffix of the file."""
    texts = {suffix: written(suffix) for suffix in SUFFIXES}
    for language in LANGUAGES:
        suffix, folder = language.suffix, tmp_path_factory.mktemp("programs")
        if suffix in SUFFIXES:
            arc = arc_request(suffix, ARC_PROGRAMS[suffix].text, arc_poses(arm), arm, folder)
            for request in (arc, program(language, arm, folder)):
                export_model("targets", request)
                texts[suffix].append(request.out.read_bytes().decode())
    points = inline_points(arm, tmp_path_factory.mktemp("points"))
    export_model("targets", points)
    return texts | {".dat": [points.out.read_bytes().decode()]}


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".dat"])
def test_exported_programs_comply(suffix, programs):
    for text in programs[suffix]:
        check_program(suffix, text)
        if suffix in (".src", ".dat"):  # capitals have no meaning in KRL, except in its header
            check_program(suffix, re.sub(r"(?m)^[^&\n].*", lambda line: line.group().lower(), text))


NUMBER = r"-?\d+\.\d+"
FAULTS = {
    ".script": (
        (r"\nend\s*\Z", "\n"),
        (r"\)\n", "\n"),
        (r"\(", ""),
        (rf"movej\(\[{NUMBER}, ", "movej(["),
        (rf"(movej\(\[{NUMBER}, )", r"\g<1>1.0, "),
        (rf"p\[{NUMBER}, ", "p["),
        (rf"(p\[{NUMBER}), ", r"\1 "),
        (r"\bdef\b", "function"),
        (r"\bmovej\(", "MoveJ("),
        (r"\bset_tcp\(", "set_tool("),
        (r"\nend\b", "\nEnd"),
        (r"\):\n", ")\n"),
        (r"\Z", "movej(q)\n"),
        (r" = ", " "),
        (r"(\d)\.(\d)", r"\1.\2.\2"),
        (r"(\d)\n  ", r"\1 "),
    ),
    ".src": (
        (r"\r?\nEND\s*\Z", "\n"),
        (r"\r?\nENDFOR", ""),
        (r"(?<=\d)\}", ""),
        (r"(?<=PTP )\{", ""),
        (r"A6 -?[\d.]+|, A6 -?[\d.]+", ""),
        (r", A3 -?[\d.]+", ""),
        (r"\bA2 ", "A3 "),
        (r", C -?[\d.]+", ""),
        (r"(?m)^PTP ", "PPT "),
        (r"(?m)^LIN ", "LINE "),
        (r"WAIT SEC", "WAIT SECONDS"),
        (r"DECL INT", "DECLARE INT"),
        (r"\bDEF\b", "DEFINE"),
        (r"\Z", "PTP XHOME\n"),
        (r"(?<=\d), ", " "),
        (r" = ", " "),
        (r"(?m)^(END\s*)\Z", r"DECL INT LATE\n\1"),
        (r"(?m)^DEF \w+", f"DEF {'a' * 25}"),
        (r"DEF (\w+)\s*\(\s*\)", r"DEF \1"),
        (r"(\d)\.(\d)", r"\1.\2.\2"),
    ),
    ".dat": (
        (r"ENDDAT", "END"),
        (r"ENDDAT\s*\Z", ""),
        (r",B -?[\d.]+|, B -?[\d.]+", ""),
        (r",A6 0", ""),
        (r"DECL FDAT", "DECL"),
        (r"\}", ""),
        (r"\Z", "DECL INT LATE\n"),
        (r"E6POS (\w+)=", r"E6POS \1 "),
    ),
    ".ls": (
        (r"/END\s*\Z", ""),
        (r"/POS", ""),
        (r"/MN", "/mn"),
        (r"/ATTR", "/ATTRIBUTES"),
        (r" ;", ""),
        (r"\};", "}"),
        (r"(?m)^\};", ";"),
        (r" deg", ""),
        (r"  ?mm,", ","),
        (r" deg", " mm"),
        (rf"J4= +{NUMBER} deg,\s", ""),
        (rf"Y = +{NUMBER} +mm,\s", ""),
        (r"J2=", "J3="),
        (r"CONFIG : '[^']*'", "CONFIG : ''"),
        (r",\s*CONFIG : '[^']*'", ""),
        (r"FINE", "Fine"),
        (r"(?m):J P", ":j P"),
        (r"(?m):J P", ":M P"),
        (r"(\d)% FINE", r"\1 FINE"),
        (r"(\d)mm/sec", r"\1"),
        (r"(\d)mm/sec", r"\1%"),
        (r"(?m)^( *\d+:[JL] P\[\d+)\]", r"\1"),
        (r"P\[1\]\{", "P[99]{"),
        (r"(?m)^( +)2:", r"\g<1>3:"),
        (r"LINE_COUNT = ", "LINE_COUNT = 1"),
        (r"UFRAME_NUM=0", "UFRAME_NUM="),
        (r"UT : (\d)", r"UT : \1.5"),
        (r"WAIT 2", "PAUSE 2"),
        (r"!(?=\w)", "!" + 30 * "x"),
        (r"\Z", "P[1]\n"),
        (r"/PROG +\w+", "/PROG  cell"),
    ),
}


@pytest.mark.parametrize(("suffix", "pattern", "other"), [(s, *fault) for s in FAULTS for fault in FAULTS[s]])
def test_faults_are_found(suffix, pattern, other, programs):
    texts = [text for text in programs[suffix] if re.search(pattern, without_remarks(suffix, text))]
    assert texts
    for text in texts:
        with pytest.raises((LarkError, AssertionError)):
            check_program(suffix, re.sub(pattern, other, without_remarks(suffix, text), count=1))


def without_remarks(suffix: str, text: str) -> str:
    """Leave out remarks that would hide a fault; those of FANUC have numbers and remain."""
    mark = {".script": "#", ".src": ";", ".dat": ";"}.get(suffix)
    return re.sub(rf"(?m)[ \t]*{mark}.*\n", "\n", text) if mark else text


EXCERPTS = {
    # KRL: constructs of kuka/examples in antlr/grammars-v4, and of programs of inline forms in public repositories
    "declarations.src": """DEF sample()
DECL INT n
DECL POS above
DECL AXIS start
FOR n=1 TO 6
$VEL_AXIS[n]=40
ENDFOR
start = {AXIS: A1 10,A2 -80,A3 95,A4 0,A5 20,A6 0}
PTP start
IF $IN[3] == FALSE THEN
above = {POS: X 410,Y 20,Z 900,A 0,B 90,C 0}
ELSE
above = {POS: X 390,Y -20,Z 900,A 0,B 90,C 0}
ENDIF
END
""",
    "inline.src": """&ACCESS RVP
&REL 3
&PARAM TEMPLATE = C:\\KRC\\Roboter\\Template\\vorgabe
DEF inline( )
EXT BAS (BAS_COMMAND :IN,REAL :IN )
INT count
;FOLD INI
  GLOBAL INTERRUPT DECL 3 WHEN $STOPMESS==TRUE DO IR_STOPM ( )
  INTERRUPT ON 3
  BAS (#INITMOV,0 )
;ENDFOLD (INI)
;FOLD PTP P1 Vel=50 % PDAT1
$BWDSTART=FALSE
PDAT_ACT=PPDAT1
FDAT_ACT={TOOL_NO 1,BASE_NO 2,IPO_FRAME #BASE}
BAS(#PTP_PARAMS,50)
PTP XP1 C_DIS
;ENDFOLD
$VEL.CP=0.2 ; m/s
LIN XP2 C_DIS C_DIS
SWITCH count
CASE 1, 2
TRIGGER WHEN DISTANCE = 0 DELAY = 20 DO $OUT[4] = TRUE
DEFAULT
Wait Sec 0.5
ENDSWITCH
PTP {A1 0,A2 -90,A3 90,A4 0,A5 0,A6 0,E1 0,E2 0}
END""",
    "inline.dat": """&ACCESS RVP
DEFDAT  INLINE PUBLIC
EXT  BAS (BAS_COMMAND  :IN,REAL  :IN )
DECL INT SUCCESS
DECL PDAT PPDAT1={VEL 50.0000,ACC 100.000,APO_DIST 50.0000,APO_MODE #CDIS}
DECL E6POS XP1={X 812.5,Y -3.25,Z 640.0,A 178.4,B .25,C -179.9,S 2,T 34,E1 0.0,E2 0.0}
DECL FDAT FP1={TOOL_NO 1,BASE_NO 2,IPO_FRAME #BASE,POINT2[] " ",TQ_STATE FALSE}
ENDDAT
""",
    # FANUC: constructs of programs that controllers wrote, in the public repositories GilbertPan97/HandEyeSync (two
    # groups) and of Pick-it's documentation (registers, calls, conditions)
    "groups.ls": """/PROG  GROUPS
/ATTR
OWNER\t\t= MNEDITOR;
COMMENT\t\t= "";
CREATE\t\t= DATE 25-02-03  TIME 10:20:30;
FILE_NAME\t= ;
LINE_COUNT\t= 3;
PROTECT\t\t= READ_WRITE;
TCD:  STACK_SIZE\t= 0,
      TASK_PRIORITY\t= 50;
DEFAULT_GROUP\t= 1,1,*,*,*;
CONTROL_CODE\t= 00000000 00000000;
LOCAL_REGISTERS\t= 0,0,0;
/APPL
/MN
   1:   ;
   2:  OVERRIDE=30% ;
   3:L P[1] 80mm/sec CNT100    ;
/POS
P[1]{
   GP1:
\tUF : 0, UT : 0,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX = -1371.166  mm,\tY =  2539.539  mm,\tZ =  -538.770  mm,
\tW =  -175.187 deg,\tP =   -34.176 deg,\tR =     -.384 deg
   GP2:
\tUF : 0, UT : 0,\t
\tJ1=     6.425 deg
};
/END
""",
    "registers.ls": """/PROG  REGISTERS\t  Macro
/ATTR
LINE_COUNT\t= 13;
/MN
   1:  UFRAME_NUM=1 ;
   2:  R[4:offset]=(-50)    ;
   3:  PR[1,3:above]=R[4:offset]+2.5 ;
   4:  CALL FIND_PART(R[4:offset],1) ;
   5:  LBL[1:again] ;
   6:  IF (R[5:found]<>0 AND DI[3]=ON) THEN ;
   7:J P[1:detect] 60% CNT80 Tool_Offset,PR[1:above]    ;
   8:  WAIT   1.50(sec) ;
   9:  ENDIF ;
  10:  IF R[5:found]=0,JMP LBL[1] ;
  11:  DO[2:grip]=PULSE,0.5sec ;
  12:L PR[2] R[6]mm/sec FINE
    :  ACC50 Offset,PR[1]    ;
  13:  END ;
/POS
P[1:"detect"]{
   GP1:
\tUF : 1, UT : 1,\t
\tJ1=    10.000 deg,\tJ2=   -20.000 deg,\tJ3=    30.000 deg,
\tJ4=     0.000 deg,\tJ5=    45.000 deg,\tJ6=    -5.000 deg
};
/END
""",
    # URScript: constructs of external_control.urscript of UniversalRobots/Universal_Robots_Client_Library (functions,
    # threads, critical sections), of the examples of the ROS 2 driver (moves), and of the script manual
    "threads.script": """def threads():
  global speeds = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
  def reachable(first, last, time, quick=False):
    local i = 0
    while i < 6:
      if norm(last[i] - first[i]) / time > 2.5e0 and not quick:
        textmsg(str_cat(
          "joint ", to_str(i)), " is too fast")
        return False
      elif time <= 0:
        halt
      end
      i = i + 1
    end
    return True
  end

  thread mover():
    while (True):
      enter_critical
      q = speeds
      exit_critical
      speedj(q, 4.0, get_steptime())
    end
  end
  handle = run mover()
  sleep(1)
  kill handle
end
""",
    "moves.script": """# moves to poses
def moves():
  set_tcp(p[0, 0, 0.12, 0, 0, 0])
  set_digital_out(1, True)
  movej(p[-0.2, -0.3, 0.8, 1, 1, 3.14], a=1.2, v=0.25, r=0)
  movej([-1.95, -1.58, 1.16, -1.15, -1.55, 1.18], a=1.0, v=0.5)
  movel(pose_trans(get_actual_tcp_pose(), p[0, 0, 0.05, 0, 0, 0]), 1.2, 0.1)
  movec(p[0.1, 0.2, 0.3, 0, 3.1, 0], p[0.2, 0.2, 0.3, 0, 3.1, 0], a=1.2, v=0.1, r=0.01)
  q = get_inverse_kin(p[0.2, 0.2, 0.3, 0, 3.1, 0])
  movej(q)
  stopj(2)
end
""",
}


@pytest.mark.parametrize("name", EXCERPTS)
def test_programs_with_constructs_of_others_comply(name):
    """The languages are wider than what is exported."""
    check_program(Path(name).suffix, EXCERPTS[name])
