MODULE PisigmaClient
    ! Corrected joint values from "pisigma serve": lines of JSON over a socket.
    ! Written from ABB's published description of RAPID, not tested on a controller. It needs the option PC Interface.
    VAR socketdev pisigma;

    PROC PisigmaConnect(string host, num port)
        SocketCreate pisigma;
        SocketConnect pisigma, host, port;
    ENDPROC

    ! Joint values for a pose of the tool in the frame of the measurements. FALSE if there are none: do not move then.
    FUNC bool PisigmaJoints(pose requested, num number, INOUT robjoint target)
        VAR num q{6};
        VAR bool reached;
        VAR bool understood;
        SocketSend pisigma \Str:="{""id"": " + NumToStr(number, 0) + ", ""brief"": true, ""pose"": [";
        SocketSend pisigma \Str:=NumToStr(requested.trans.x, 4) + ", " + NumToStr(requested.trans.y, 4) + ", ";
        SocketSend pisigma \Str:=NumToStr(requested.trans.z, 4) + ", " + NumToStr(EulerZYX(\Z, requested.rot), 5) + ", ";
        SocketSend pisigma \Str:=NumToStr(EulerZYX(\Y, requested.rot), 5) + ", ";
        SocketSend pisigma \Str:=NumToStr(EulerZYX(\X, requested.rot), 5) + "]}\0A";
        reached := PisigmaRead(q);
        IF reached THEN
            target := [q{1}, q{2}, q{3}, q{4}, q{5}, q{6}];
        ENDIF
        RETURN reached;
    ENDFUNC

    ! A string has at most 80 characters, so the line is read character by character.
    FUNC bool PisigmaRead(INOUT num q{*})
        VAR rawbytes data;
        VAR string character := "";
        VAR string word := "";
        VAR string tail := "";
        VAR num position := 1;
        VAR num joint := 0;
        VAR bool reached := FALSE;
        VAR bool understood := TRUE;
        WHILE character <> "\0A" DO
            IF position > RawBytesLen(data) THEN
                SocketReceive pisigma \RawData:=data \Time:=5;
                position := 1;
            ENDIF
            UnpackRawBytes data, position, character \ASCII:=1;
            position := position + 1;
            tail := tail + character;
            IF StrLen(tail) > 9 THEN
                tail := StrPart(tail, 2, 9);
            ENDIF
            IF tail = """reached""" THEN
                reached := TRUE;
            ENDIF
            IF character = "[" THEN
                joint := 1;
                word := "";
            ELSEIF joint > 0 AND (character = "," OR character = "]") THEN
                understood := understood AND StrToVal(word, q{joint});
                joint := joint + 1;
                word := "";
                IF character = "]" THEN
                    joint := 0;
                ENDIF
            ELSEIF joint > 0 THEN
                word := word + character;
            ENDIF
        ENDWHILE
        RETURN reached AND understood;
    ENDFUNC
ENDMODULE
