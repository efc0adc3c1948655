"""Functions of the controllers' languages that set neither frame nor tool, unlike other routines, which may."""

_URSCRIPT = """
movej movel movep movec servoj servoc speedj speedl stopj stopl freedrive_mode end_freedrive_mode
teach_mode end_teach_mode position_deviation_warning reset_revolution_counter
get_conveyor_tick_count force get_actual_joint_positions get_actual_joint_positions_history
get_actual_joint_speeds get_actual_tcp_pose get_actual_tcp_speed get_actual_tool_flange_pose
get_controller_temp get_forward_kin get_inverse_kin get_inverse_kin_has_solution get_joint_temp
get_joint_torques get_steptime get_target_joint_positions get_target_joint_speeds get_target_payload
get_target_payload_cog get_target_payload_inertia get_target_tcp_pose get_target_tcp_speed
get_target_waypoint get_tcp_force get_tcp_offset get_tool_accelerometer_reading get_tool_current
is_steady is_within_safety_limits popup powerdown set_gravity set_payload set_payload_cog
set_payload_mass set_target_payload sleep sync textmsg to_num to_str str_at str_cat str_empty
str_find str_len str_sub tool_contact acos asin atan atan2 binary_list_to_integer ceil cos d2r floor
get_list_length integer_to_binary_list interpolate_pose inv length log norm normalize point_dist
pose_add pose_dist pose_inv pose_sub pose_trans pow r2d random rotvec2rpy rpy2rotvec sin size sqrt
tan transpose wrench_trans range get_analog_in get_analog_out get_configurable_digital_in
get_configurable_digital_out get_digital_in get_digital_out get_euromap_input get_euromap_output
get_flag get_standard_analog_in get_standard_analog_out get_standard_digital_in
get_standard_digital_out get_tool_analog_in get_tool_analog_out get_tool_digital_in
get_tool_digital_out set_analog_in set_analog_inputrange set_analog_out set_analog_outputdomain
set_configurable_digital_out set_digital_out set_euromap_output set_flag
set_standard_analog_input_domain set_standard_analog_out set_standard_digital_out
set_tool_analog_input_domain set_tool_analog_out set_tool_communication set_tool_digital_out
set_tool_output_mode set_tool_digital_output_mode set_tool_voltage rpc_factory
read_input_boolean_register read_input_float_register read_input_integer_register
read_output_boolean_register read_output_float_register read_output_integer_register read_port_bit
read_port_register write_output_boolean_register write_output_float_register
write_output_integer_register write_port_bit write_port_register rtde_set_watchdog modbus_add_signal
modbus_delete_signal modbus_get_signal_status modbus_send_custom_command modbus_set_output_register
modbus_set_output_signal modbus_set_signal_update_frequency socket_close socket_get_var socket_open
socket_read_ascii_float socket_read_binary_integer socket_read_byte_list socket_read_line
socket_read_string socket_send_byte socket_send_int socket_send_line socket_send_string
socket_set_var assert struct and or not in xor while if elif return
"""
_KRL = """
abs sin cos acos atan2 tan sqrt b_and b_or b_exor b_not cast_from cast_to pulse ir_stopm varstate
copen cclose cread cwrite cioctl sread swrite strlen strclear stradd strfind strcomp strcopy
strdeclen forward inverse inv_pos get_sig_inf if while until switch for and or not exor to wait
return case when do interrupt trigger bas
"""
_RAPID = """
accset acteventbuffer actunit add aliascamera aliasio aliasioreset bitclear bitset bookerrno break
camflush camgetparameter camgetresult camloadjob camreqimage camsetexposure camsetparameter
camsetprogrammode camsetrunmode camstartloadjob camwaitloadjob cancelload checkprogref cirpathmode
clear cleariobuff clearpath clearrawbytes clkreset clkstart clkstop close closedir confj confl
connect copyfile copyrawbytes cornerpathwarning deacteventbuffer deactunit decr ditheract
ditherdeact eoffsoff erasemodule errlog errraise errwrite exit exitcycle getdataval getsysdata
gettrapdata goto gripload hollowwristreset idelete idisable ienable ierror incr indamove indcmove
inddmove indreset indrmove invertdo iodisable ioenable ipers irmqmessage isignalai isignalao
isignaldi isignaldo isignalgi isignalgo isleep itimer ivarvalue iwatch load loadid makedir
manloadidproc mechunitload motionprocessmodeset motionsup movecdo movecao movecgo moveextj open
opendir packdnheader packrawbytes pathacclim pathlengthreset pathlengthstart pathlengthstop
pathrecmovebwd pathrecmovefwd pathrecstart pathrecstop pathresol pdispoff procerrrecovery pulsedo
raise raisetouser readanybin readblock readcfgdata readerrdata readrawbytes readvararr removedir
removefile renamefile reset resetaxisdistance resetppmoved resetretrycount resettorquemargin
restopath retry return rewind rmqemptyqueue rmqfindslot rmqgetmessage rmqgetmsgdata rmqgetmsgheader
rmqreadwait rmqsendmessage rmqsendwait save savecfgdata scwrite searchextj sendevice set
setalldataval setao setdatasearch setdataval setdo setgo setleadthrough setsysdata singarea
skipwarn socketaccept socketbind socketclose socketconnect socketcreate socketlisten socketreceive
socketreceivefrom socketsend socketsendto softact softdeact speedlimaxis speedlimcheckpoint
speedrefresh spystart spystop startload startmove startmoveretry stcalib stclose stindgun
stindgunreset stop stopen stopmove stopmovereset storepath sttune sttunereset systemstopaction
testsigndefine testsignreset texttabinstall tperase tpreaddnum tpreadfk tpreadnum tpshow tpwrite
triggcheckio triggdatacopy triggdatareset triggequip triggint triggio triggrampao triggspeed
triggstopproc tryint trynext tunereset tuneservo uimsgbox uimsgwrite uimsgwriteabort uishow unload
unpackrawbytes velset waitai waitao waitdi waitdo waitgi waitgo waitload waitrob waitsynctask
waittestandset waittime waituntil warmstart worldacclim write writeanybin writebin writeblock
writecfgdata writerawbytes writestrbin writevar writevararr wzboxdef wzcyldef wzdisable wzdoset
wzenable wzfree wzhomejointdef wzlimjointdef wzlimsup wzsphdef
const pers var local task module endmodule proc endproc func endfunc trap endtrap record endrecord
alias if elseif else endif for endfor while endwhile test case default endtest error undo backward
"""
URSCRIPT = frozenset(_URSCRIPT.split())
"""Functions of URScript, and words that may be followed by brackets."""
KRL = frozenset(_KRL.upper().split())
"""Functions of KRL in capitals, and words that may be followed by brackets."""
RAPID = frozenset(_RAPID.upper().split())
"""Instructions of RAPID in capitals, except for moves, and words that start statements."""
